"""Atlases on disk: a folder that grows, in which no file is ever written again.

Every file is HDF5 with the attributes ``format``, ``schema``, ``about`` (JSON: everything that is
no array) and ``checksum``, computed like a vademecum's (schema 2.0):

    frame.h5               template/vertices (n_v, 3) [m], template/tets (n_t, 4),
                           template/clamped and template/accessible over the boundary faces
    NAME/level_set.h5      distances (D,) [m]
    NAME/response.h5       space (3 n_v, k) [m/N], load (3 n_s, k), missing (n_s, 3, 3), if computed
    NAME/shape.h5          registered (n_v, 3) [m]

``about`` of an anatomy's first two files is the key in its shape. The shape is written last: a
folder without a shape is no member. Deleting its folder removes an anatomy.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from avatar_core.atlas.anatomy import Anatomy, Origin, Response, ResponseKind, WholeAnatomy
from avatar_core.atlas.frame import Frame
from avatar_core.atlas.model import Atlas
from avatar_core.common.array_shapes import Shapes, require_indices, require_shapes
from avatar_core.common.arrays import FloatArray
from avatar_core.common.dataclass_json import of_plain, parsed, require_name
from avatar_core.common.files import FileError, opened
from avatar_core.common.hdf5 import replace_file, require_schema, verified
from avatar_core.errors import AvatarError, StorageError
from avatar_core.geometry.level_set import GridBox
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.shapes.registration import (
    RegistrationQuality,
    SimilarityTransform,
    Template,
    TemplateRule,
)

ATLAS_SCHEMA = "2.0"
MAX_FILE_BYTES = 1 << 30
MAX_POINTS = 10_000_000  # points of the box; an atlas has 50,000
MOST_STEPS = 1000  # steps of a registration, in each of its loops
FRAME, SHAPE, LEVEL_SET, RESPONSE = "frame.h5", "shape.h5", "level_set.h5", "response.h5"

Arrays = dict[str, np.ndarray]

_ARRAYS: dict[str, Shapes] = {
    FRAME: {
        "template/vertices": "f: template 3",
        "template/tets": "i: tets 4",
        "template/clamped": "b: faces",
        "template/accessible": "b: faces",
    },
    SHAPE: {"registered": "f: template 3"},
    LEVEL_SET: {"distances": "f: points"},
    RESPONSE: {
        "space": "f: 3*template rank",
        "load": "f: 3*positions rank",
        "missing": "f: positions 3 3",
    },
}
_FORMATS = {
    FRAME: "avatar atlas",
    SHAPE: "avatar anatomy",
    LEVEL_SET: "avatar level set",
    RESPONSE: "avatar response",
}
_AGAIN = "delete the anatomy's folder and add its surface again"


@dataclass(frozen=True)
class _Frame:
    """Everything of a frame that is no array; made_from: hash of the build's inputs."""

    template: str
    box: GridBox
    rule: TemplateRule
    made_from: str


@dataclass(frozen=True)
class _Alignment:
    scale: float
    rotation: tuple[tuple[float, ...], ...]
    translation: tuple[float, ...]


@dataclass(frozen=True)
class _Shape:
    """Everything of a shape that is no array."""

    key: str
    volume: float
    converged: bool
    quality: RegistrationQuality
    origin: Origin
    alignment: _Alignment
    response: ResponseKind | None = None


# --- the atlas --------------------------------------------------------------------------------


def load_atlas(path: str | Path) -> Atlas:
    """Read and verify an atlas, without level sets and responses.

    Raises
    ------
    StorageError
        For a folder that is no atlas, and for a truncated, altered or foreign file in it.

    Examples
    --------
    >>> av.load_atlas("base").names
    ('larger', 'phantom')
    """
    folder = Path(path)
    frame, _ = load_frame(folder)
    return Atlas(
        frame,
        tuple(_load_shape(folder / name, frame) for name in member_names(folder)),
        partial(_load_distances, folder, frame),
        partial(_load_response, folder, frame),
    )


def member_names(folder: Path) -> list[str]:
    """Return the names of the members, sorted; nothing is read."""
    return sorted(file.parent.name for file in folder.glob(f"*/{SHAPE}"))


def n_bytes(folder: Path) -> int:
    """Return the size of all files of an atlas [bytes]."""
    return sum(file.stat().st_size for file in (*folder.glob("*.h5"), *folder.glob("*/*.h5")))


# --- its frame --------------------------------------------------------------------------------


def save_frame(folder: Path, frame: Frame, made_from: str) -> None:
    """Write the frame of an atlas into its folder; StorageError if it cannot be."""
    template = frame.template
    arrays: Arrays = {
        "template/vertices": template.mesh.vertices,
        "template/tets": template.mesh.tets,
        "template/clamped": template.regions.clamped,
        "template/accessible": template.regions.accessible,
    }
    about = _Frame(template.name, frame.box, frame.rule, made_from)
    _write(folder / FRAME, arrays, asdict(about))


def load_frame(folder: Path) -> tuple[Frame, str]:
    """Return the frame of an atlas, and the hash of its inputs.

    Raises StorageError unless the folder is an atlas of this version.
    """
    if folder.is_file():
        raise StorageError(
            f"{folder} is a file, and an atlas is a folder; make one with 'avatar atlas create "
            "FOLDER SURFACE...'"
        )
    arrays, about = _read(folder / FRAME, "make it again with 'avatar atlas create'")
    try:
        said = of_plain(_Frame, about, "about")
        _require_box(said.box)
        _require_rule(said.rule)
        template = _template(arrays, require_name(said.template, "about.template"))
    except AvatarError as error:
        raise StorageError(f"{folder / FRAME}: {error}") from error
    return Frame(template, said.box, said.rule), said.made_from


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


def _require_rule(rule: TemplateRule) -> None:
    loops = (rule.n_stages, rule.sweeps, 1 + rule.last_sweeps)
    finite = all(math.isfinite(value) and value >= 0 for value in asdict(rule).values())
    if not finite or not all(1 <= n <= MOST_STEPS for n in loops) or rule.n_samples > MAX_POINTS:
        raise StorageError("'about.rule' would register nothing; build the atlas again")


# --- an anatomy -------------------------------------------------------------------------------


def save_anatomy(folder: Path, anatomy: WholeAnatomy) -> None:
    """Write an anatomy into the folder of an atlas; it is a member once its shape is there.

    Raises
    ------
    StorageError
        If the folder cannot be made or the disk is full; the atlas is then unchanged.
    """
    shape, response = anatomy.shape, anatomy.response
    own = folder / shape.name
    try:
        own.mkdir(exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot make {own} ({error.strerror})") from error
    _write(own / LEVEL_SET, {"distances": anatomy.distances}, shape.key)
    if response is not None:
        arrays = {"space": response.space, "load": response.load}
        missing = response.residual_compliance
        _write(own / RESPONSE, {**arrays, "missing": missing}, shape.key)
    alignment = shape.alignment
    about = {
        "key": shape.key,
        "volume": shape.volume,
        "converged": shape.converged,
        "quality": asdict(shape.quality),
        "origin": asdict(shape.origin),
        "alignment": {
            "scale": alignment.scale,
            "rotation": alignment.rotation.tolist(),
            "translation": alignment.translation.tolist(),
        },
        "response": None if response is None else asdict(response.kind),
    }
    _write(own / SHAPE, {"registered": shape.registered}, about)


def _load_shape(own: Path, frame: Frame) -> Anatomy:
    arrays, about = _read(own / SHAPE)
    try:
        return _anatomy(require_name(own.name, "the name"), arrays, about, frame)
    except AvatarError as error:
        raise StorageError(f"{own / SHAPE}: {error}") from error


def _anatomy(name: str, arrays: Arrays, about: Any, frame: Frame) -> Anatomy:
    said = of_plain(_Shape, about, "about")
    alignment = said.alignment
    rotation, translation = np.array(alignment.rotation), np.array(alignment.translation)
    placed = np.isfinite([alignment.scale, said.volume, *rotation.flat, *translation.flat]).all()
    if rotation.shape != (3, 3) or translation.shape != (3,) or not placed:
        raise StorageError(f"'about' has an alignment or a volume that is none; {_AGAIN}")
    if arrays["registered"].shape != frame.template.mesh.vertices.shape:
        raise StorageError(f"'registered' does not fit the atlas's template; {_AGAIN}")
    return Anatomy(
        name,
        said.key,
        said.origin,
        said.volume,
        SimilarityTransform(alignment.scale, rotation, translation),
        arrays["registered"],
        said.quality,
        said.converged,
        said.response,
    )


def _load_distances(folder: Path, frame: Frame, anatomy: Anatomy) -> FloatArray:
    file = folder / anatomy.name / LEVEL_SET
    distances = _read_of(file, anatomy)["distances"]
    if distances.shape != (frame.n_points,):
        raise StorageError(f"{file} does not fit the atlas's grid; {_AGAIN}")
    return distances


def _load_response(folder: Path, frame: Frame, anatomy: Anatomy) -> Response:
    file, kind = folder / anatomy.name / RESPONSE, anatomy.response
    if kind is None:
        raise StorageError(f"{anatomy.name} has no response; {_AGAIN}")
    arrays = _read_of(file, anatomy)
    if len(arrays["space"]) != frame.template.mesh.vertices.size:
        raise StorageError(f"{file} does not fit the atlas's template; {_AGAIN}")
    return Response(
        space=arrays["space"],
        load=arrays["load"],
        residual_compliance=arrays["missing"],
        material=kind.material,
        element=kind.element,
        patch_radius=kind.patch_radius,
    )


def _read_of(file: Path, anatomy: Anatomy) -> Arrays:
    arrays, key = _read(file)
    if key != anatomy.key:
        raise StorageError(f"{file} belongs to another anatomy; {_AGAIN}")
    return arrays


# --- files ------------------------------------------------------------------------------------


def _write(file: Path, arrays: Arrays, about: Any) -> None:
    said = {"format": _FORMATS[file.name], "schema": ATLAS_SCHEMA, "about": json.dumps(about)}
    replace_file(file, arrays, said)


def _read(file: Path, remedy: str = _AGAIN) -> tuple[Arrays, Any]:
    """Return the arrays and JSON of a file of an atlas, verified; StorageError with the remedy."""
    kind, held_keys = _FORMATS[file.name], ("format", "schema", "about")

    def choose(held: dict[str, str], origin: str) -> dict[str, str]:
        if held.get("format") != kind:
            raise StorageError(f"{origin} is HDF5 but no {kind.removeprefix('avatar ')}; {remedy}")
        require_schema(held, ATLAS_SCHEMA, origin, remedy)
        return {key: held[key] for key in held_keys}

    what = kind.removeprefix("avatar ")
    try:
        with opened(file, MAX_FILE_BYTES) as source:
            attributes, arrays = verified(source, str(file), what, choose, list, remedy)
    except FileError as error:
        where = file.parent if file.name == FRAME else file
        raise StorageError(f"no {what} at {where} ({error}); {remedy}") from error
    try:
        require_shapes(arrays, _ARRAYS[file.name])
        return arrays, parsed(attributes["about"], "about")
    except AvatarError as error:
        raise StorageError(f"{file}: {error}") from error
