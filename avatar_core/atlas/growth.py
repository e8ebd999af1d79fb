"""Building an atlas from surfaces, on all cores or a cluster.

Each finished anatomy is written at once into the atlas's folder, and no existing file is written
again. A surface that is in the atlas is not built again: a stopped build is resumed by running it
again.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from avatar_core.atlas.anatomy import Anatomy, AtlasError, Origin, Response, WholeAnatomy, free_name
from avatar_core.atlas.frame import LARGEST_ORGAN, SPACING, Frame, box_around
from avatar_core.atlas.model import Atlas
from avatar_core.atlas.storage import (
    FRAME,
    load_atlas,
    load_frame,
    member_names,
    save_anatomy,
    save_frame,
)
from avatar_core.atlas.workers import Workers
from avatar_core.common.processes import repeatable
from avatar_core.errors import AvatarError, StorageError
from avatar_core.geometry.doubts import size_notice
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.geometry.surface_files import content_of
from avatar_core.shapes.registration import (
    Registration,
    Template,
    TemplateRule,
    not_converged,
    register_template,
)

Axes = str | tuple[tuple[float, ...], ...]
SolveResponse = Callable[[Registration], Response]
Progress = Callable[[int, int, str], None]
_BATCH = 256  # surfaces that are given to the workers at once, so that not all are in memory


@dataclass(frozen=True)
class SurfaceFile:
    """A surface that is read by the worker that builds the anatomy; see `read_surface`."""

    path: Path
    unit: str = "mm"
    axes: Axes | None = None
    label: int | str | None = None

    @property
    def name(self) -> str:
        """Name of the anatomy: the file's name without suffixes."""
        return self.path.name.split(".")[0]

    def read(self) -> SurfaceMesh:
        """Read the surface; raises SurfaceError if the file holds none."""
        return read_surface(self.path, self.unit, self.axes, self.label)


Source = SurfaceFile | SurfaceMesh


@dataclass(frozen=True)
class AtlasOptions:
    """Settings that are fixed when an atlas is created.

    Attributes
    ----------
    template_vertices : int
        Approximate number of vertices of the template, the mesh of the built-in liver.
    largest : tuple[float, float, float]
        Size of the largest organ that fits into the box, along x, y, z [m].
    spacing : float
        Spacing of the grid in the box [m].
    rule : TemplateRule
        Rule of all registrations.

    Examples
    --------
    >>> av.AtlasOptions(template_vertices=700).spacing
    0.009
    """

    template_vertices: int = 2500
    largest: tuple[float, float, float] = LARGEST_ORGAN
    spacing: float = SPACING
    rule: TemplateRule = field(default_factory=TemplateRule)


@dataclass(frozen=True)
class Skipped:
    """A surface that was not added, and the reason in one line."""

    name: str
    reason: str


@dataclass(frozen=True, eq=False)
class Growth:
    """Result of a build.

    Attributes
    ----------
    atlas : Atlas
        Atlas with the new members.
    added : tuple[str, ...]
        Names of the new members.
    known : tuple[str, ...]
        Names of members whose surfaces were given again; nothing was done for them.
    skipped : tuple[Skipped, ...]
        Surfaces that were not added.
    notices : tuple[str, ...]
        New members that are duplicates, whose registration did not converge, or whose surface was
        changed on reading, one line each.
    """

    atlas: Atlas
    added: tuple[str, ...]
    known: tuple[str, ...]
    skipped: tuple[Skipped, ...]
    notices: tuple[str, ...]


def new_frame(template: Template, options: AtlasOptions | None = None) -> Frame:
    """Return the frame of a new atlas.

    Raises AtlasError if the box or the spacing is unreasonable.
    """
    options = options or AtlasOptions()
    return Frame(template, box_around(template, options.largest, options.spacing), options.rule)


def default_template(n_vertices: int = 2500) -> Template:
    """Return the built-in liver as a template, with clamp and accessible region by rule."""
    return Template.of(phantom_liver(), n_vertices)


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
    """Build an atlas in a new folder, or go on with a build of the same options.

    Nothing is left if no surface can be used.

    Parameters
    ----------
    path : str or Path
        Folder of the atlas.
    sources : sequence of SurfaceMesh or SurfaceFile
        Surfaces of the organs.
    options : AtlasOptions or None
        Sizes of template and grid.
    template : Template or None
        None takes the built-in liver with ``options.template_vertices``.
    workers : Workers or None
        Processes that build the anatomies. None takes this one. A script that asks for more needs
        ``if __name__ == "__main__":``, as each process imports it again.
    solve_response : callable or None
        Solver of each registration's Response, e.g. ``ResponseSolver()``; picklable. None stores
        shapes alone.
    progress : callable or None
        Called with (surfaces done, number of surfaces, name) after each surface.

    Raises
    ------
    AtlasError
        If the folder holds something else, or another build is at work on it.
    StorageError
        If it cannot be written.

    Examples
    --------
    >>> options = {"template": template, "workers": alone, "solve_response": solver}
    >>> grown = av.create_atlas("created", [liver, larger], rough_options, **options)
    >>> grown.atlas.names
    ('larger', 'phantom')
    """
    folder, options = Path(path), options or AtlasOptions()
    with _folder_of(folder):
        frame = _begun(folder, options, template)
        return _grow(folder, frame, sources, workers or Workers(jobs=1), solve_response, progress)


def extend_atlas(
    path: str | Path,
    sources: Sequence[Source],
    *,
    workers: Workers | None = None,
    solve_response: SolveResponse | None = None,
    progress: Progress | None = None,
) -> Growth:
    """Add surfaces to an atlas on disk; no file that is there is written.

    Arguments are those of `create_atlas`. Raises StorageError if there is no atlas at the path or
    it cannot be written, AtlasError if another build is at work on it.

    Examples
    --------
    >>> given = {"template": template, "workers": alone}
    >>> grown = av.create_atlas("grown", [liver], rough_options, **given)
    >>> av.extend_atlas("grown", [larger], workers=alone).added
    ('larger',)
    """
    folder = Path(path)
    frame, _ = load_frame(folder)
    with _folder_of(folder):
        return _grow(folder, frame, sources, workers or Workers(jobs=1), solve_response, progress)


# --- the folder -------------------------------------------------------------------------------


@contextmanager
def _folder_of(folder: Path) -> Iterator[None]:
    """Make the folder and lock it for one build; it is removed again if it has no member then.

    Raises AtlasError if another build holds it, StorageError if it cannot be made.
    """
    if folder.is_file():
        raise AtlasError(f"{folder} is a file, and an atlas is a folder; give another name")
    try:
        folder.mkdir(exist_ok=True)
        handle = os.open(folder, os.O_RDONLY)
    except OSError as error:
        raise StorageError(
            f"cannot make {folder} ({error.strerror}); create its folder first, or choose another"
        ) from error
    try:
        _lock(handle, folder)
        try:
            yield
        finally:
            _remove_if_empty(folder)
    finally:
        os.close(handle)


def _remove_if_empty(folder: Path) -> None:
    if member_names(folder) or any(one.is_dir() for one in folder.iterdir()):
        return
    if all(one.name == FRAME or one.name.startswith(f".{FRAME}") for one in folder.iterdir()):
        for file in folder.iterdir():
            file.unlink(missing_ok=True)
        folder.rmdir()


def _lock(handle: int, folder: Path) -> None:
    """Lock the folder until the handle is closed, by the system if the process is killed."""
    import fcntl

    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise AtlasError(
            f"another build is at work on {folder}; wait until it has finished"
        ) from error


def _begun(folder: Path, options: AtlasOptions, template: Template | None) -> Frame:
    """Return the frame of a new atlas, or the frame of a build that was stopped.

    Meshing a template again would give another mesh: it is made once and kept.
    """
    made_from = _hash_of_options(options, template)
    if (folder / FRAME).exists():
        frame, before = load_frame(folder)
        if before != made_from:
            raise AtlasError(
                f"{folder} exists, made with other options; grow it by 'avatar atlas add', or "
                "give another folder"
            )
        return frame
    if any(folder.iterdir()):
        raise AtlasError(f"{folder} exists and is no atlas; give another folder")
    frame = new_frame(template or default_template(options.template_vertices), options)
    save_frame(folder, frame, made_from)
    return frame


def _hash_of_options(options: AtlasOptions, template: Template | None) -> str:
    digest = hashlib.sha256(json.dumps(asdict(options), sort_keys=True).encode())
    if template is not None:
        for array in (template.mesh.vertices, template.mesh.tets, template.regions.accessible):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:32]


# --- growing ----------------------------------------------------------------------------------


def _grow(
    folder: Path,
    frame: Frame,
    sources: Sequence[Source],
    workers: Workers,
    solve_response: SolveResponse | None,
    progress: Progress | None,
) -> Growth:
    """Build the surfaces that are not there, and write each as soon as it is finished."""
    there = load_atlas(folder)
    keys = [key_of(source) for source in sources]
    names = _names(sources, keys, there)
    results: dict[int, Anatomy | Skipped] = {}
    begun = {anatomy.key for anatomy in there.anatomies}
    todo = []
    for number, key in enumerate(keys):
        if key is None or key not in begun:
            todo.append(number)
        begun.add(key or "")
    done = len(sources) - len(todo)
    builder = AnatomyBuilder(frame, solve_response)
    for first in range(0, len(todo), _BATCH):
        batch = todo[first : first + _BATCH]
        for i, result in workers.map(builder, _items([sources[k] for k in batch], workers)):
            number = batch[i]
            if isinstance(result, WholeAnatomy):
                shape = replace(result.shape, name=names[number], key=keys[number] or "")
                save_anatomy(folder, replace(result, shape=shape))
                results[number] = shape
            elif isinstance(result, Skipped):
                results[number] = result
            else:
                results[number] = Skipped(sources[number].name, _in_one_line(result))
            done += 1
            if progress is not None:
                progress(done, len(sources), sources[number].name)
    return _growth(there, results, names)


def _items(sources: Sequence[Source], workers: Workers) -> list[Source | Skipped]:
    """Return workers' tasks: surfaces, not files, if workers may not see this machine's files."""
    return [_read_here(source) if workers.scheduler else source for source in sources]


def _names(sources: Sequence[Source], keys: Sequence[str | None], there: Atlas) -> list[str]:
    """Return the member name that each surface has or gets; a taken name gets a number."""
    taken = {anatomy.name for anatomy in there.anatomies}
    by_key = {anatomy.key: anatomy.name for anatomy in there.anatomies}
    names = []
    for source, key in zip(sources, keys, strict=True):
        name = by_key.get(key or "") or free_name(_folder_name(source.name), taken)
        taken.add(name)
        if key is not None:
            by_key[key] = name
        names.append(name)
    return names


def _folder_name(name: str) -> str:
    """Return a name that is allowed for a folder."""
    return name.replace("/", "_").lstrip(".") or "anatomy"


def _growth(there: Atlas, results: Mapping[int, Anatomy | Skipped], names: list[str]) -> Growth:
    """Return the result with members in the order of the surfaces, not of completion."""
    ordered = [results[number] for number in sorted(results)]
    new = [one for one in ordered if isinstance(one, Anatomy)]
    members = sorted((*there.anatomies, *new), key=lambda one: one.name)
    atlas, added = replace(there, anatomies=tuple(members)), tuple(one.name for one in new)
    notices = [str(one) for one in atlas.duplicates if one.name in added]
    for one in new:
        notices += [] if one.converged else [f"{one.name}: {not_converged(one.quality)}"]
        notices += [f"{one.name}: {notice}" for notice in one.origin.notices]
    return Growth(
        atlas,
        added,
        tuple(name for number, name in enumerate(names) if number not in results),
        tuple(one for one in ordered if isinstance(one, Skipped)),
        tuple(notices),
    )


def key_of(source: Source) -> str | None:
    """Return a hash of a surface's content and its reading; None for an unreadable file."""
    digest = hashlib.sha256()
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


# --- one anatomy ------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class AnatomyBuilder:
    """Builder of an atlas's anatomies; picklable, so that workers can use it."""

    frame: Frame
    solve_response: SolveResponse | None = None

    def __call__(self, source: Source | Skipped) -> WholeAnatomy | Skipped:
        """Return the anatomy of a surface, or the reason why there is none; never raises."""
        if isinstance(source, Skipped):
            return source
        try:
            return build_anatomy(self.frame, source, self.solve_response)
        except AvatarError as error:
            return Skipped(source.name, str(error))
        except Exception as error:  # a singular matrix, memory that ran out
            return Skipped(source.name, _in_one_line(error))


@repeatable
def build_anatomy(
    frame: Frame, source: Source, solve_response: SolveResponse | None = None
) -> WholeAnatomy:
    """Read and register one organ, and compute its distances and, if asked, its response.

    Raises
    ------
    AvatarError
        From the stage that failed, with the remedy.
    """
    surface = source.read() if isinstance(source, SurfaceFile) else source
    frame.require_room(surface)
    registration = register_template(frame.template, surface, frame.rule)
    response = solve_response(registration) if solve_response else None
    shape = Anatomy(
        name=surface.name,
        key=key_of(source) or "",
        origin=Origin(
            surface.source_sha256,
            surface.unit,
            surface.axes_name,
            len(surface.vertices),
            surface.notices + size_notice(surface),
        ),
        volume=surface.volume,
        alignment=registration.alignment,
        registered=registration.mesh.vertices,
        quality=registration.quality,
        converged=registration.converged,
        response=response.kind if response else None,
    )
    distances = frame.distance_vector(surface, registration.alignment)
    return WholeAnatomy(shape, distances, response)


def _read_here(source: Source | Skipped) -> Source | Skipped:
    if not isinstance(source, SurfaceFile):
        return source
    try:
        return source.read()
    except AvatarError as error:
        return Skipped(source.name, str(error))


def _in_one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
