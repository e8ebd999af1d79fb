"""The arrays of a vademecum file, and their checks before compiled code uses them."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping

import numpy as np

from avatar_core.common.array_shapes import Shapes, require_indices, require_shapes
from avatar_core.errors import StorageError
from avatar_core.geometry.mesh import TetMesh

Arrays = Mapping[str, np.ndarray]

LARGEST_LENGTH = 10.0  # largest coordinate or distance of an organ [m]
_SPACINGS = (1e-4, 0.1)  # least and largest spacing of the tip field [m]
_PATCH_RADII = (1e-4, 0.1)  # [m]

# Keys are attribute paths of a Vademecum; see array_shapes for the notation.
_LINEAR: Shapes = {
    "mesh/vertices": "f: vertices 3",
    "mesh/tets": "i: tets 4",
    "regions/clamped": "b: faces",
    "regions/accessible": "b: faces",
    "surface/centers": "f: positions 3",
    "surface/normals": "f: positions 3",
    "surface/corners": "i: triangles 3",
    "surface/vertices": "i: corners",
    "surface/patch_radius": "f:",
    "far/space": "f: 3*vertices rank",
    "far/load": "f: 3*positions rank",
    "trailing": "f: 3*positions trailing",
    "blocks/vertex": "i: 64*blocks",
    "field/region": "i: positions",
    "field/load": "f: positions 3 most",
    "field/count": "i: field_parts",
    "field/space": "s: modes 192",
    "field/core": "f: modes most",
    "field/level": "i: modes",
    "field/start": "i: field_parts block_starts",
    "contact_near/start": "i: rows",
    "contact_near/target": "i: contact_blocks",
    "contact_near/block": "f: contact_blocks 3 3",
    "tip_field/distance": "f: nx ny nz",
    "tip_field/access": "f: nx ny nz",
    "tip_field/origin": "f: 3",
    "tip_field/spacing": "f: 1",
}
_PARAMETRIC: Shapes = {
    "parametric/basis/space": "f: 3*vertices basis",
    "parametric/basis/load": "f: 3*positions basis",
    "parametric/operators": "f: terms basis basis",
    "parametric/n_global": "i:",
    "parametric/rank": "i:",
    "parametric/young_modulus": "f:",
    "parametric/projection": "f: regions regional basis",
    "parametric/regional_load": "f: nodes positions 3 regional",
    "parametric/core": "f: modes global",
    "parametric/contact_near": "f: nodes contact_blocks 3 3",
}
_BODY: Shapes = {"body/mass": "f: rank rank", "body/weight": "f: rank 3"}
_PARAMETRIC_BODY: Shapes = {
    "parametric/body/mass": "f: basis basis",
    "parametric/body/weight": "f: basis 3",
}
_TUMOUR: Shapes = {"tip_field/tumour": "f: nx ny nz"}
_OUTLINE: Shapes = {
    "tip_field/outline/vertices": "f: outlined 3",
    "tip_field/outline/faces": "i: outline_faces 3",
}
_LARGE: Shapes = {
    "large/terms/region": "i: positions",
    "large/terms/load": "f: positions 4 large_most",
    "large/terms/count": "i: field_parts",
    "large/terms/space": "s: large_modes 192",
    "large/terms/core": "f: large_modes large_most",
    "large/terms/level": "i: large_modes",
    "large/terms/start": "i: field_parts block_starts",
    "large/depth": "f: 2 2 positions",
    "large/reach": "f: 2 positions",
}
_DISPLAY: Shapes = {
    "display/vertices": "f: displayed 3",
    "display/faces": "i: display_faces 3",
    "display/corners": "i: displayed 4",
    "display/weights": "f: displayed 4",
    "display/first_face": "i: parts",
}
_SUPPORTS: Shapes = {"supports/faces": "b: supports faces"}
_RESECTION: Shapes = {
    "mesh/pairs": "i: pairs 2",
    "resection/direction": "f: 3",
    "resection/fronts": "f: fronts",
    "resection/opened": "f:",
    "resection/stiffness": "f:",
    "resection/halfway": "f:",
}
BODY_KEYS = tuple(_BODY)
PARAMETRIC_KEYS = tuple(_PARAMETRIC)
PARAMETRIC_BODY_KEYS = tuple(_PARAMETRIC_BODY)
LARGE_KEYS = tuple(_LARGE)
TUMOUR_KEYS = tuple(_TUMOUR)
OUTLINE_KEYS = tuple(_OUTLINE)
DISPLAY_KEYS = tuple(_DISPLAY)
SUPPORT_KEYS = tuple(_SUPPORTS)
RESECTION_KEYS = tuple(_RESECTION)

# Each is present or absent as a whole; its first key decides.
_PARTS = (
    _PARAMETRIC,
    _BODY,
    _PARAMETRIC_BODY,
    _LARGE,
    _TUMOUR,
    _OUTLINE,
    _DISPLAY,
    _SUPPORTS,
    _RESECTION,
)


def shapes_of(held: Container[str]) -> dict[str, str]:
    """Return the shapes of the arrays of a vademecum that has some keys."""
    shapes = dict(_LINEAR)
    for part in _PARTS:
        if next(iter(part)) in held:
            shapes |= part
    return shapes


def require_sound(arrays: Arrays) -> None:
    """Check shapes, indices and lengths, so that compiled code stays within bounds.

    Raises
    ------
    StorageError
        Naming the array that does not fit.
    """
    sizes = require_shapes(arrays, shapes_of(arrays))
    if min(sizes[name] for name in ("vertices", "tets", "positions", "triangles", "rank")) < 1:
        raise StorageError("the organ has no elements, load positions or modes; build it again")
    _require_mesh(arrays, sizes)
    _require_surface(arrays, sizes)
    _require_blocks(arrays, sizes)
    _require_field(arrays, "field", sizes["rank"])
    _require_rows(arrays, "contact_near", sizes["positions"], sizes["positions"])
    _require_tip_field(arrays)
    if "basis" in sizes:
        _require_range("parametric/rank", float(arrays["parametric/rank"]), (1, sizes["basis"]))
        rank, n_global = arrays["parametric/rank"], arrays["parametric/n_global"]
        _require_range("parametric/n_global", float(n_global), (1, float(rank)))
        same = sizes["global"] == sizes["rank"] == int(n_global)
        if not (same and sizes["regions"] + 1 == sizes["field_parts"]):
            raise StorageError("'parametric/core' does not fit 'field'; build the file again")
    if "displayed" in sizes:
        _require_display(arrays, sizes)
    if "large/reach" in arrays:
        _require_field(arrays, "large/terms", 0)
        if not np.array_equal(arrays["large/terms/region"], arrays["field/region"]):
            raise StorageError(
                "'large/terms/region' differs from 'field/region'; build the file again"
            )
        if arrays["large/reach"].min() < 0.0:
            raise StorageError("'large/reach' is negative; build the file again")


def _require_mesh(arrays: Arrays, sizes: Mapping[str, int]) -> None:
    _require_lengths(arrays, "mesh/vertices")
    require_indices("mesh/tets", arrays["mesh/tets"], sizes["vertices"])
    vertices, pairs = arrays["mesh/vertices"], arrays.get("mesh/pairs")
    if pairs is not None:
        require_indices("mesh/pairs", pairs, sizes["vertices"])
        first, second = pairs.T
        alone = len(np.unique(pairs)) == pairs.size > 0
        if not (alone and np.array_equal(vertices[first], vertices[second])):
            raise StorageError("'mesh/pairs' do not lie at one place each; build the file again")
    mesh = TetMesh(vertices, arrays["mesh/tets"], pairs)
    if pairs is not None and len(mesh.cut_faces[0]) == 0:
        raise StorageError("'mesh/pairs' are no cut; build the file again")
    if len(mesh.boundary_faces) != sizes["faces"]:
        raise StorageError("'regions' are not those of the mesh; build the file again")


def _require_surface(arrays: Arrays, sizes: Mapping[str, int]) -> None:
    _require_lengths(arrays, "surface/centers")
    _require_range("surface/patch_radius", float(arrays["surface/patch_radius"]), _PATCH_RADII)
    require_indices("surface/vertices", arrays["surface/vertices"], sizes["vertices"])
    corners, n_corners = arrays["surface/corners"], sizes["corners"]
    require_indices("surface/corners", corners, n_corners)
    if sizes["positions"] == n_corners:
        return
    edges = np.unique(np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    if sizes["positions"] != n_corners + len(edges):
        raise StorageError(
            "'surface/centers' are neither the corners nor these and all edge midpoints; build the "
            "file again"
        )


def _require_display(arrays: Arrays, sizes: Mapping[str, int]) -> None:
    """Require vertices of an organ's size, within tetrahedra; faces in parts of one at least."""
    _require_lengths(arrays, "display/vertices")
    require_indices("display/faces", arrays["display/faces"], sizes["displayed"])
    require_indices("display/corners", arrays["display/corners"], sizes["vertices"])
    first = arrays["display/first_face"].astype(np.int64)
    whole = len(first) > 1 and first[0] == 0 and first[-1] == sizes["display_faces"]
    if not (whole and (np.diff(first) > 0).all()):
        raise StorageError("'display/first_face' does not fit its faces; build the file again")
    weights = arrays["display/weights"]
    if weights.min(initial=0.0) < 0.0 or np.abs(weights.sum(axis=1) - 1.0).max(initial=0.0) > 1e-5:
        raise StorageError("'display/weights' are no parts of a whole; build the file again")


def _require_blocks(arrays: Arrays, sizes: Mapping[str, int]) -> None:
    """Require blocks that hold each vertex once."""
    vertex = arrays["blocks/vertex"].astype(np.int64)
    held = np.sort(vertex[vertex >= 0])
    if not np.array_equal(held, np.arange(sizes["vertices"])) or vertex.min() < -1:
        raise StorageError("'blocks/vertex' is no order of the vertices; build the file again")
    if sizes["block_starts"] != sizes["blocks"] + 1:
        raise StorageError("'field/start' does not fit 'blocks/vertex'; build the file again")


def _require_field(arrays: Arrays, name: str, n_shared: int) -> None:
    """Require existing regions and ordered modes, with no more amplitudes than their loads."""
    count, start = (arrays[f"{name}/{key}"].astype(np.int64) for key in ("count", "start"))
    if len(count) < 2:
        raise StorageError(f"'{name}/count' names no region; build the file again")
    require_indices(f"{name}/region", arrays[f"{name}/region"], len(count) - 1)
    most, n_modes = arrays[f"{name}/core"].shape[1], len(arrays[f"{name}/space"])
    if not (count[0] == n_shared and count.min() >= n_shared and count.max() <= most):
        raise StorageError(f"'{name}/count' does not fit its amplitudes; build the file again")
    require_indices(f"{name}/start", start, n_modes + 1)
    joined = (start[1:, 0] == start[:-1, -1]).all() and (np.diff(start, axis=1) >= 0).all()
    if not joined or start[0, 0] != 0 or start[-1, -1] != n_modes:
        raise StorageError(f"'{name}/start' does not fit its modes; build the file again")


def _require_rows(arrays: Arrays, name: str, n_rows: int, n_targets: int) -> None:
    """Require compressed rows of an upper half: ascending, from the first block to the last."""
    start, target = arrays[f"{name}/start"], arrays[f"{name}/target"]
    require_indices(f"{name}/target", target, n_targets)
    require_indices(f"{name}/start", start, len(target) + 1)
    rises = len(start) == n_rows + 1 and bool((start[1:] >= start[:-1]).all())
    if not rises or start[0] != 0 or start[-1] != len(target):
        raise StorageError(f"'{name}/start' does not fit its blocks; build the file again")
    if (target < np.repeat(np.arange(n_rows), np.diff(start))).any():
        raise StorageError(f"'{name}/target' lies before its position; build the file again")


def _require_tip_field(arrays: Arrays) -> None:
    for key in ("tip_field/distance", "tip_field/origin"):
        _require_lengths(arrays, key)
    _require_range("tip_field/spacing", float(arrays["tip_field/spacing"][0]), _SPACINGS)
    if min(arrays["tip_field/distance"].shape) < 3:
        raise StorageError("'tip_field' has fewer than 3 samples along an axis; build it again")
    if OUTLINE_KEYS[0] in arrays:
        vertices, faces = (arrays[key] for key in OUTLINE_KEYS)
        _require_lengths(arrays, OUTLINE_KEYS[0])
        require_indices(OUTLINE_KEYS[1], faces, len(vertices))


def _require_lengths(arrays: Arrays, key: str) -> None:
    if np.abs(arrays[key]).max(initial=0.0) > LARGEST_LENGTH:
        raise StorageError(
            f"'{key}' has lengths above {LARGEST_LENGTH:g} m, as no organ; build the file again"
        )


def _require_range(key: str, value: float, bounds: tuple[float, float]) -> None:
    if not (math.isfinite(value) and bounds[0] <= value <= bounds[1]):
        raise StorageError(
            f"'{key}' is {value:g}, not {bounds[0]:g} to {bounds[1]:g}; build the file again"
        )
