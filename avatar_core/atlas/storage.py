"""Atlases on disk: one HDF5 file with schema version and checksum, replaced as a whole or not.

Layout (schema 1.0), attributes at the root: ``format`` = "avatar atlas", ``schema``, ``about``
(JSON: template's name, box, registration rule), ``checksum`` as of vademecums. Datasets:

    template/vertices (n_v, 3) [m]      template/tets (n_t, 4)
    template/clamped, template/accessible over the boundary faces
    gram/origin (D,) [m]                gram/products (n, n) [m2]
    anatomies/000000/about              JSON as bytes: everything that is no array
    anatomies/000000/vertices (., 3) [m]        anatomies/000000/faces (., 3)
    anatomies/000000/distances (D,) [m]         anatomies/000000/registered (n_v, 3) [m]
    anatomies/000000/space (3 n_v, k) [m/N]     anatomies/000000/load (3 n_s, k), if computed
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from avatar_core.atlas.anatomy import Anatomy, Response
from avatar_core.atlas.model import Atlas
from avatar_core.common.array_shapes import Shapes, require_indices, require_shapes
from avatar_core.common.dataclass_json import of_plain, parsed, require_name
from avatar_core.common.files import FileError, opened
from avatar_core.common.hdf5 import replace_file, require_schema, verified
from avatar_core.errors import AvatarError, StorageError
from avatar_core.fem.elasticity import Element, Material
from avatar_core.geometry.level_set import GridBox
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.geometry.surface import SurfaceMesh, axes_matrix
from avatar_core.shapes.lle import Gram
from avatar_core.shapes.registration import (
    RegistrationQuality,
    RegistrationRule,
    SimilarityTransform,
    Template,
)

ATLAS_SCHEMA = "1.0"
ATLAS_FORMAT = "avatar atlas"
ANATOMY_FORMAT = "avatar anatomy"
MAX_FILE_BYTES = 64 << 30
MAX_POINTS = 10_000_000  # of the box; an atlas has 50,000
MOST_STEPS = 1000  # of a registration, in each of its loops

Arrays = dict[str, np.ndarray]
Made = TypeVar("Made")

_TEMPLATE: Shapes = {
    "template/vertices": "f: template 3",
    "template/tets": "i: tets 4",
    "template/clamped": "b: faces",
    "template/accessible": "b: faces",
    "gram/origin": "f: points",
    "gram/products": "f: n n",
}
_ANATOMY: Shapes = {
    "about": "i: letters",
    "vertices": "f: vertices 3",
    "faces": "i: faces 3",
    "distances": "f: points",
    "registered": "f: template 3",
}
_RESPONSE: Shapes = {
    "space": "f: 3*template rank",
    "load": "f: 3*positions rank",
    "missing": "f: positions 3 3",
}


@dataclass(frozen=True)
class _Surface:
    name: str
    unit: str
    axes: tuple[tuple[float, ...], ...]
    notices: tuple[str, ...]
    source_sha256: str


@dataclass(frozen=True)
class _Alignment:
    scale: float
    rotation: tuple[tuple[float, ...], ...]
    translation: tuple[float, ...]


@dataclass(frozen=True)
class _Response:
    material: Material
    element: Element
    patch_radius: float


@dataclass(frozen=True)
class _Anatomy:
    """Everything of an anatomy that is no array."""

    name: str
    volume: float
    converged: bool
    quality: RegistrationQuality
    surface: _Surface
    alignment: _Alignment
    response: _Response | None = None


@dataclass(frozen=True)
class _About:
    """Everything of an atlas that is no array."""

    template: str
    box: GridBox
    rule: RegistrationRule


def save_atlas(atlas: Atlas, path: str | Path) -> None:
    """Write an atlas; what was at the path stays until the new file is complete.

    Raises
    ------
    StorageError
        If the folder does not exist or the disk is full; the old file is then unharmed.
    """
    template, gram = atlas.template, atlas.gram
    arrays: Arrays = {
        "template/vertices": template.mesh.vertices,
        "template/tets": template.mesh.tets,
        "template/clamped": template.regions.clamped,
        "template/accessible": template.regions.accessible,
        "gram/origin": gram.origin,
        "gram/products": gram.products,
    }
    for number, anatomy in enumerate(atlas.anatomies):
        group = f"anatomies/{number:06d}"
        arrays |= {f"{group}/{key}": value for key, value in _anatomy_arrays(anatomy).items()}
    about = {"template": template.name, "box": asdict(atlas.box), "rule": asdict(atlas.rule)}
    replace_file(Path(path), arrays, _attributes(ATLAS_FORMAT, about))


def load_atlas(path: str | Path) -> Atlas:
    """Read and verify an atlas.

    Raises
    ------
    StorageError
        For a missing, truncated, altered or foreign file, and for one of another schema.
    """
    return _read(Path(path), ATLAS_FORMAT, _atlas)


def save_anatomy(anatomy: Anatomy, path: Path) -> None:
    """Write one anatomy on its own, complete or not at all; StorageError if it cannot be."""
    replace_file(path, _anatomy_arrays(anatomy), _attributes(ANATOMY_FORMAT, {}))


def load_anatomy(path: Path) -> Anatomy:
    """Read and verify an anatomy on its own; StorageError unless it is as it was written."""
    return _read(path, ANATOMY_FORMAT, lambda arrays, _: _anatomy(arrays))


# --- to arrays and back -----------------------------------------------------------------------


def _attributes(kind: str, about: dict[str, Any]) -> dict[str, str]:
    return {"format": kind, "schema": ATLAS_SCHEMA, "about": json.dumps(about)}


def _anatomy_arrays(anatomy: Anatomy) -> Arrays:
    surface, alignment, response = anatomy.surface, anatomy.alignment, anatomy.response
    about: dict[str, Any] = {
        "name": anatomy.name,
        "volume": anatomy.volume,
        "converged": anatomy.converged,
        "quality": asdict(anatomy.quality),
        "surface": {
            "name": surface.name,
            "unit": surface.unit,
            "axes": surface.axes.tolist(),
            "notices": surface.notices,
            "source_sha256": surface.source_sha256,
        },
        "alignment": {
            "scale": alignment.scale,
            "rotation": alignment.rotation.tolist(),
            "translation": alignment.translation.tolist(),
        },
    }
    arrays: Arrays = {
        "vertices": surface.vertices,
        "faces": surface.faces,
        "distances": anatomy.distances,
        "registered": anatomy.registered,
    }
    if response is not None:
        arrays |= {"space": response.space, "load": response.load}
        arrays["missing"] = response.residual_compliance
        about["response"] = {
            "material": asdict(response.material),
            "element": response.element,
            "patch_radius": response.patch_radius,
        }
    return {**arrays, "about": np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)}


def _anatomy(arrays: Arrays) -> Anatomy:
    sizes = require_shapes(arrays, _ANATOMY | (_RESPONSE if "space" in arrays else {}))
    require_indices("faces", arrays["faces"], sizes["vertices"])
    text = arrays["about"].astype(np.uint8).tobytes().decode(errors="replace")
    about = of_plain(_Anatomy, parsed(text, "about"), "about")
    stored, alignment = about.surface, about.alignment
    rotation, translation = np.array(alignment.rotation), np.array(alignment.translation)
    placed = np.isfinite([alignment.scale, about.volume, *rotation.flat, *translation.flat]).all()
    if rotation.shape != (3, 3) or translation.shape != (3,) or not placed:
        raise StorageError("'about' has an alignment or a volume that is none; build it again")
    return Anatomy(
        name=require_name(about.name, "about.name"),
        surface=SurfaceMesh(
            arrays["vertices"],
            arrays["faces"],
            require_name(stored.name, "about.surface.name"),
            stored.unit,
            axes_matrix(stored.axes),
            stored.notices,
            stored.source_sha256,
        ),
        volume=about.volume,
        alignment=SimilarityTransform(alignment.scale, rotation, translation),
        distances=arrays["distances"],
        registered=arrays["registered"],
        quality=about.quality,
        converged=about.converged,
        response=_response(arrays, about.response),
    )


def _response(arrays: Arrays, about: _Response | None) -> Response | None:
    if (about is None) != ("space" not in arrays):
        raise StorageError("a response is there in part; build the file again")
    if about is None:
        return None
    return Response(
        space=arrays["space"],
        load=arrays["load"],
        residual_compliance=arrays["missing"],
        material=about.material,
        element=about.element,
        patch_radius=about.patch_radius,
    )


def _atlas(arrays: Arrays, about: Any) -> Atlas:
    require_shapes(arrays, _TEMPLATE)
    said = of_plain(_About, about, "about")
    _require_box(said.box)
    _require_rule(said.rule)
    return Atlas(
        template=_template(arrays, require_name(said.template, "about.template")),
        box=said.box,
        rule=said.rule,
        anatomies=tuple(_named(number, group) for number, group in _groups(arrays)),
        gram=Gram(arrays["gram/origin"], arrays["gram/products"]),
    )


def _named(number: str, group: Arrays) -> Anatomy:
    try:
        return _anatomy(group)
    except AvatarError as error:
        raise StorageError(f"anatomies/{number}: {error}") from error


def _template(arrays: Arrays, name: str) -> Template:
    part = {key: arrays[f"template/{key}"] for key in ("vertices", "tets", "clamped", "accessible")}
    require_indices("template/tets", part["tets"], len(part["vertices"]))
    mesh = TetMesh(part["vertices"], part["tets"])
    if len(mesh.boundary_faces) != len(part["clamped"]):
        raise StorageError("the regions are not those of the template; build the atlas again")
    return Template(name, mesh, Regions(part["clamped"], part["accessible"]))


def _require_box(box: GridBox) -> None:
    finite = all(map(math.isfinite, (*box.origin, box.spacing)))
    if not finite or box.spacing <= 0.0 or min(box.shape) < 1 or math.prod(box.shape) > MAX_POINTS:
        raise StorageError("'about.box' is no grid of this project; build the atlas again")


def _require_rule(rule: RegistrationRule) -> None:
    loops = (rule.n_stages, rule.sweeps, 1 + rule.last_sweeps)
    finite = all(math.isfinite(value) and value >= 0 for value in asdict(rule).values())
    if not finite or not all(1 <= n <= MOST_STEPS for n in loops) or rule.n_samples > MAX_POINTS:
        raise StorageError("'about.rule' would register nothing; build the atlas again")


def _groups(arrays: Arrays) -> Iterator[tuple[str, Arrays]]:
    """Number and arrays of each anatomy, in the order of their numbers."""
    groups: dict[str, Arrays] = {}
    for key in sorted(arrays):
        if key.startswith("anatomies/"):
            _, number, *name = key.split("/")
            groups.setdefault(number, {})["/".join(name)] = arrays[key]
    yield from groups.items()


# --- files ------------------------------------------------------------------------------------


def _read(path: Path, kind: str, assemble: Callable[[Arrays, Any], Made]) -> Made:
    """What `assemble` makes of the arrays and the JSON, once both are verified."""
    what = kind.removeprefix("avatar ")
    try:
        with opened(path, MAX_FILE_BYTES) as source:
            attributes, arrays = verified(source, str(path), what, _attributes_of(kind), list)
    except FileError as error:
        raise StorageError(
            f"no {what} at {path} ({error}); make one with 'avatar atlas create'"
        ) from error
    try:
        return assemble(arrays, parsed(attributes["about"], "about"))
    except AvatarError as error:
        raise StorageError(f"{path}: {error}") from error


def _attributes_of(kind: str) -> Callable[[dict[str, str], str], dict[str, str]]:
    """Those that count, of a file of this kind and the present schema."""

    def choose(held: dict[str, str], origin: str) -> dict[str, str]:
        if held.get("format") != kind:
            raise StorageError(
                f"{origin} is HDF5 but no {kind.removeprefix('avatar ')}; make one with 'avatar "
                "atlas create'"
            )
        require_schema(held, ATLAS_SCHEMA, origin, "make it again with 'avatar atlas create'")
        return {key: held[key] for key in ("format", "schema", "about")}

    return choose
