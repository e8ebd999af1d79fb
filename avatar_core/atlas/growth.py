"""Building an atlas from surfaces, on all cores or a cluster; an interrupted build is resumed.

Each finished anatomy is saved at once in the folder ``ATLAS.h5.parts``, under a hash of its inputs.
The atlas itself is written at the end, in one step, and the folder is removed.
"""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from avatar_core.atlas.anatomy import Anatomy, AtlasError, Response
from avatar_core.atlas.checkpoint import Checkpoint, checkpoint_of
from avatar_core.atlas.model import LARGEST_ORGAN, SPACING, Atlas, box_around
from avatar_core.atlas.storage import ATLAS_SCHEMA, load_atlas, save_atlas
from avatar_core.atlas.workers import Workers
from avatar_core.common.processes import repeatable
from avatar_core.errors import AvatarError
from avatar_core.geometry.doubts import size_notice
from avatar_core.geometry.mesh import regions_by_rule, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.geometry.surface_files import content_of
from avatar_core.shapes.registration import (
    Registration,
    RegistrationRule,
    Template,
    not_converged,
    register,
)

Axes = str | tuple[tuple[float, ...], ...]
SolveResponse = Callable[[Registration], Response]
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class SurfaceFile:
    """A surface that is read by the worker that builds the anatomy; see `read_surface`."""

    path: Path
    unit: str = "mm"
    axes: Axes | None = None
    label: int | str | None = None

    @property
    def name(self) -> str:
        """Name of the anatomy: that of the file without suffixes."""
        return self.path.name.split(".")[0]

    def read(self) -> SurfaceMesh:
        """Read the surface; raises SurfaceError if the file holds none."""
        return read_surface(self.path, self.unit, self.axes, self.label)


Source = SurfaceFile | SurfaceMesh


@dataclass(frozen=True)
class AtlasOptions:
    """Settings that are fixed when an atlas is created.

    template_vertices : approximate number, of the mesh of the built-in liver, the template
    largest : size of the largest organ that fits into the box, along x, y, z [m]
    spacing : of the grid in the box [m]
    rule : RegistrationRule of all registrations
    """

    template_vertices: int = 2500
    largest: tuple[float, float, float] = LARGEST_ORGAN
    spacing: float = SPACING
    rule: RegistrationRule = field(default_factory=RegistrationRule)


@dataclass(frozen=True)
class Skipped:
    """A surface that was not added, and the reason in one line."""

    name: str
    reason: str


@dataclass(frozen=True, eq=False)
class Growth:
    """Result of a build.

    atlas : with the new members; not on disk if there are none
    added : names of the new members
    skipped : surfaces that were not added
    resumed : number of new members that an interrupted build had finished
    notices : new members that are duplicates, whose registration did not converge, or whose
        surface was changed on reading, one line each
    """

    atlas: Atlas
    added: tuple[str, ...]
    skipped: tuple[Skipped, ...]
    resumed: int
    notices: tuple[str, ...]


def new_atlas(template: Template, options: AtlasOptions | None = None) -> Atlas:
    """An atlas without members.

    Raises AtlasError if the box or the spacing is unreasonable.
    """
    options = options or AtlasOptions()
    return Atlas(template, box_around(template, options.largest, options.spacing), options.rule)


def default_template(n_vertices: int = 2500) -> Template:
    """The built-in liver as a template, with clamp and accessible region by the anatomical rule."""
    mesh = tetrahedralize(phantom_liver(), n_vertices)
    return Template("phantom", mesh, regions_by_rule(mesh))


def create_atlas(
    path: str | Path,
    sources: Sequence[Source],
    options: AtlasOptions | None = None,
    *,
    template: Template | None = None,
    workers: Workers | None = None,
    solve_response: SolveResponse | None = None,
    progress: Progress | None = None,
) -> Growth:
    """Build an atlas; nothing is written if no surface can be used.

    template : None for the built-in liver with ``options.template_vertices``
    solve_response : computes the Response of each registration; must be picklable
    progress : called with (surfaces done, number of surfaces, name) after each surface

    Raises AtlasError if the file exists or another build is at work on it, StorageError if it
    cannot be written.
    """
    path = Path(path)
    with checkpoint_of(path) as checkpoint:
        if path.exists():
            raise AtlasError(f"{path} exists; grow it by 'avatar atlas add', or remove it first")
        empty = _empty_atlas(checkpoint, options or AtlasOptions(), template)
        growth, _ = _grow(
            empty, sources, checkpoint, workers or Workers(), solve_response, progress
        )
        if growth.added:
            save_atlas(growth.atlas, path)
            checkpoint.clear()  # what is left belongs to other templates
    return growth


def extend_atlas(
    path: str | Path,
    sources: Sequence[Source],
    *,
    workers: Workers | None = None,
    solve_response: SolveResponse | None = None,
    progress: Progress | None = None,
) -> Growth:
    """Add surfaces to an atlas on disk; the old file stays until the new one is complete.

    Arguments are those of `create_atlas`. Raises StorageError if there is no atlas at the path or
    it cannot be written, AtlasError if another build is at work on it.
    """
    path = Path(path)
    if not path.is_file():
        load_atlas(path)  # raises, and says what is missing
    with checkpoint_of(path) as checkpoint:
        atlas = load_atlas(path)
        growth, keys = _grow(
            atlas, sources, checkpoint, workers or Workers(), solve_response, progress
        )
        if growth.added:
            save_atlas(growth.atlas, path)
            checkpoint.clear(keys)
    return growth


def _empty_atlas(checkpoint: Checkpoint, options: AtlasOptions, template: Template | None) -> Atlas:
    """The empty atlas that an interrupted build began with, or a new one."""
    if template is not None:
        return new_atlas(template, options)
    asked = json.dumps(asdict(options), sort_keys=True)
    key = hashlib.sha256(asked.encode()).hexdigest()[:32]
    atlas = checkpoint.load_empty(key)
    if atlas is None:
        atlas = new_atlas(default_template(options.template_vertices), options)
        checkpoint.save_empty(key, atlas)
    return atlas


def _grow(
    atlas: Atlas,
    sources: Sequence[Source],
    checkpoint: Checkpoint,
    workers: Workers,
    solve_response: SolveResponse | None,
    progress: Progress | None,
) -> tuple[Growth, list[str | None]]:
    """Result of the build, and the checkpoint keys of the surfaces."""
    builder = AnatomyBuilder(atlas.without_anatomies(), solve_response)
    keys = checkpoint_keys(builder, sources)
    results: dict[int, Anatomy | Skipped] = {}

    def keep(number: int, result: Anatomy | Skipped) -> None:
        results[number] = result
        if progress is not None:
            progress(len(results), len(sources), sources[number].name)

    for number, key in enumerate(keys):
        kept = checkpoint.load(key)
        if kept is not None:
            keep(number, kept)
    resumed = len(results)
    numbers = [number for number in range(len(sources)) if number not in results]
    todo: list[Source | Skipped] = [sources[number] for number in numbers]
    if workers.scheduler is not None:  # its workers may not see this machine's files
        todo = [_read_here(source) for source in todo]
    for i, result in workers.map(builder, todo):
        number = numbers[i]
        if isinstance(result, Exception):
            result = Skipped(sources[number].name, _in_one_line(result))
        if isinstance(result, Anatomy):
            checkpoint.save(keys[number], result)
        keep(number, result)
    return _growth(atlas, [results[i] for i in range(len(sources))], resumed), keys


def _growth(atlas: Atlas, results: Sequence[Anatomy | Skipped], resumed: int) -> Growth:
    """Result with members in the order of the surfaces, whatever the order of completion."""
    grown = atlas.with_anatomies(one for one in results if isinstance(one, Anatomy))
    added = grown.names[len(atlas) :]
    notices = tuple(str(one) for one in grown.duplicates if one.name in added) if added else ()
    notices += tuple(
        f"{one.name}: {not_converged(one.quality)}"
        for one in grown.anatomies[len(atlas) :]
        if not one.converged
    )
    notices += tuple(
        f"{one.name}: {notice}"
        for one in grown.anatomies[len(atlas) :]
        for notice in one.surface.notices + size_notice(one.surface)
    )
    skipped = tuple(one for one in results if isinstance(one, Skipped))
    return Growth(grown, added, skipped, resumed, notices)


# --- one anatomy ------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class AnatomyBuilder:
    """Builds the anatomies of an atlas; picklable, so that workers can do it."""

    atlas: Atlas
    solve_response: SolveResponse | None = None

    def __call__(self, source: Source | Skipped) -> Anatomy | Skipped:
        """The anatomy of a surface, or the reason why there is none; never raises."""
        if isinstance(source, Skipped):
            return source
        try:
            return build_anatomy(self.atlas, source, self.solve_response)
        except AvatarError as error:
            return Skipped(source.name, str(error))
        except Exception as error:  # a singular matrix, memory that ran out
            return Skipped(source.name, _in_one_line(error))


@repeatable
def build_anatomy(
    atlas: Atlas, source: Source, solve_response: SolveResponse | None = None
) -> Anatomy:
    """Read and register one organ, and compute its distances and, if asked, its response.

    Raises
    ------
    AvatarError
        Of the stage that failed, with the remedy.
    """
    surface = source.read() if isinstance(source, SurfaceFile) else source
    atlas.require_room(surface)
    registration = register(atlas.template, surface, atlas.rule)
    return Anatomy(
        name=surface.name,
        surface=surface,
        volume=surface.volume,
        alignment=registration.alignment,
        distances=atlas.distance_vector(surface, registration.alignment),
        registered=registration.mesh.vertices,
        quality=registration.quality,
        converged=registration.converged,
        response=solve_response(registration) if solve_response else None,
    )


def checkpoint_keys(builder: AnatomyBuilder, sources: Sequence[Source]) -> list[str | None]:
    """Hash of all inputs of each anatomy; None for a file that cannot be read."""
    atlas, mesh = builder.atlas, builder.atlas.template.mesh
    common = hashlib.sha256()
    for array in (mesh.vertices, mesh.tets, atlas.template.regions.accessible):
        common.update(np.ascontiguousarray(array).tobytes())
    settings = (ATLAS_SCHEMA, asdict(atlas.box), asdict(atlas.rule))
    common.update(json.dumps(settings).encode())
    common.update(pickle.dumps(builder.solve_response))
    return [_checkpoint_key(common.digest(), source) for source in sources]


def _checkpoint_key(common: bytes, source: Source) -> str | None:
    digest = hashlib.sha256(common)
    digest.update(source.name.encode())
    if isinstance(source, SurfaceFile):
        try:
            digest.update(content_of(source.path))
        except AvatarError:
            return None  # building it will say why
        digest.update(repr((source.unit, source.axes, source.label)).encode())
    else:
        digest.update(source.vertices.tobytes())
        digest.update(source.faces.tobytes())
    return digest.hexdigest()[:32]


def _read_here(source: Source | Skipped) -> Source | Skipped:
    if not isinstance(source, SurfaceFile):
        return source
    try:
        return source.read()
    except AvatarError as error:
        return Skipped(source.name, str(error))


def _in_one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
