"""Vademecums on disk: HDF5 with schema version and checksum.

Layout (schema 6.2). Attributes at the root are ``format`` = "avatar vademecum", ``schema``,
``name``, ``element`` and ``checksum``. The checksum is SHA-256 over names, types, shapes and bytes
of all datasets in sorted order and over the JSON attributes. These are ``material``,
``provenance``, ``convergence``, ``certificate``, ``accuracy`` (the curve), and those of the parts
below, null or empty without a part. Datasets:

    mesh/vertices (n_v, 3) [m]          mesh/tets (n_t, 4)
    regions/clamped, regions/accessible over the boundary faces
    surface/centers, surface/normals (n_s, 3) [m]   surface/corners (n_f, 3)
    surface/vertices                     surface/patch_radius [m]
    far/space (3 n_v, k) [m]             far/load (3 n_s, k)
    trailing (3 n_s, m), of the contact compliance
    blocks/vertex (64 n_blocks,)         field/region (n_s,), load (n_s, 3, most) [m/N]
    field/count (n_regions + 1,), start (n_regions + 1, n_blocks + 1), space (n_modes, 192),
    core (n_modes, most), level (n_modes,)
    contact_near/start, target, block [m/N]: symmetric blocks whose target is their position or
    after it
    tip_field/distance, tip_field/access, tip_field/origin, tip_field/spacing [m]
    tip_field/tumour over a tumour
    tip_field/outline/vertices (n, 3) [m], faces (m, 3)

A vademecum with coordinates of the material has the JSON attributes ``coordinates``,
``contrast``, and the datasets

    parametric/basis/space (3 n_v, n)    parametric/basis/load (3 n_s, n)
    parametric/operators (n_terms, n, n) parametric/n_global, rank, young_modulus [Pa]
    parametric/projection (n_regions, m, n), regional_load (n_nodes, n_s, 3, m)
    parametric/core (n_modes, n_global)
    parametric/contact_near (n_nodes, n_blocks, 3, 3) [m/N], as of contact_near

A vademecum with the organ's mass has body/mass (rank, rank) and body/weight (rank, 3), and the
same under parametric/body for that basis. With a finer surface or structures to display it has

    display/vertices (n, 3) [m]          display/faces (m, 3)
    display/corners (n, 4)               display/weights (n, 4), of the mesh's vertices
    display/first_face (n_parts + 1,), with the JSON attribute ``parts``, their names

On supports it has supports/faces (n_supports, n_faces) over the boundary faces. The JSON attribute
``supports`` holds their names and stiffnesses [N/m^3]. If it is cut, it has

    mesh/pairs (n_pairs, 2), vertices of both sides at one place
    resection/direction (3,), fronts (n_strips + 1,) [m], opened, stiffness and halfway
    [N/m^3]

With large deformation it has the JSON attribute ``large`` (material, certificate), and for k = 2, 3

    large/terms/..., load (n_s, 4, most) [m^(1-k)], as of field: of pushes, then of pulls
    large/depth (2, 2, n_s) [m^(1-k)]    large/reach (2, n_s) [m]
"""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from avatar_core.common.dataclass_json import of_plain, parsed, require_name
from avatar_core.common.files import FileError, opened
from avatar_core.common.hdf5 import checksum, format_of, replace_file, require_schema, verified
from avatar_core.common.supports import SUPPORT
from avatar_core.errors import AvatarError, StorageError
from avatar_core.fem.elasticity import Element, Material
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.fem.resection import Resection
from avatar_core.fem.supports import Support
from avatar_core.geometry.mesh import Regions, TetMesh
from avatar_core.reduction.block_field import BlockField, Blocks
from avatar_core.reduction.coordinates import RESECTION, Coordinate
from avatar_core.reduction.near_field import LocalBlocks, Mirror
from avatar_core.reduction.separated import SeparatedField
from avatar_core.vademecum.accuracy import AccuracyCurve, Cloud
from avatar_core.vademecum.certificate import Certificate
from avatar_core.vademecum.display import ORGAN, Display
from avatar_core.vademecum.large_deformation import (
    LargeCertificate,
    LargeDeformation,
    LargeMaterial,
)
from avatar_core.vademecum.modal_mass import BodyResponse
from avatar_core.vademecum.model import SCHEMA_VERSION, Vademecum
from avatar_core.vademecum.parametric import ParametricResponse
from avatar_core.vademecum.record import Convergence, Provenance
from avatar_core.vademecum.schema import (
    BODY_KEYS,
    DISPLAY_KEYS,
    LARGE_KEYS,
    OUTLINE_KEYS,
    PARAMETRIC_BODY_KEYS,
    PARAMETRIC_KEYS,
    RESECTION_KEYS,
    SUPPORT_KEYS,
    TUMOUR_KEYS,
    require_sound,
    shapes_of,
)
from avatar_core.vademecum.tip_field import Outline, TipField

FORMAT = "avatar vademecum"
MAX_FILE_BYTES = 4 << 30

_JSON = (
    "material",
    "provenance",
    "convergence",
    "certificate",
    "accuracy",
    "coordinates",
    "contrast",
    "large",
    "parts",
    "supports",
)


def save_vademecum(vademecum: Vademecum, path: str | Path) -> str:
    """Write a vademecum; the file appears complete or not at all.

    Returns its id: the same for the same surface, options and versions, see `id_of`.

    Raises
    ------
    StorageError
        If the folder does not exist or the disk is full; nothing is left behind.

    Examples
    --------
    >>> file_hash = av.save(v, "copy.h5")
    >>> av.load("copy.h5").id == file_hash
    True
    """
    arrays, attributes = _arrays(vademecum), _attributes(vademecum)
    replace_file(Path(path), arrays, attributes, packed=True)
    return id_of(arrays, attributes)


def load_vademecum(path: str | Path) -> Vademecum:
    """Read and verify a vademecum.

    Sizes are checked before anything is allocated, the checksum before anything is used.

    Raises
    ------
    StorageError
        For a missing, truncated, altered or foreign file, and for one of another schema.

    Examples
    --------
    >>> av.load("liver.h5").name
    'phantom'
    """
    path = Path(path)
    try:
        with opened(path, MAX_FILE_BYTES) as source:
            return _read(source, str(path))
    except FileError as error:
        raise StorageError(
            f"no vademecum at {path} ({error}); build one with 'avatar vademecum'"
        ) from error


def parse_vademecum(content: bytes | memoryview, origin: str) -> Vademecum:
    """Read and verify a vademecum in memory; see :func:`load_vademecum`.

    Parameters
    ----------
    content : bytes or memoryview
        The bytes of a vademecum file.
    origin : str
        Its name in messages.
    """
    if len(content) > MAX_FILE_BYTES:
        raise StorageError(f"{origin} has {len(content) >> 20} MiB, more than a vademecum may have")
    return _read(io.BytesIO(content), origin)


def is_vademecum(path: str | Path) -> bool:
    """Return whether a path is a regular HDF5 file of a vademecum's format; no more is read."""
    return format_of(Path(path), MAX_FILE_BYTES) == FORMAT


def _read(source: BinaryIO, origin: str) -> Vademecum:
    attributes, arrays = verified(source, origin, "vademecum", _attributes_of, shapes_of)
    try:
        vademecum = _assemble(arrays, attributes)
    except AvatarError as error:
        raise StorageError(f"{origin}: {error}") from error
    nbytes = source.seek(0, os.SEEK_END)
    return replace(vademecum, id=id_of(arrays, attributes), nbytes=nbytes)


def id_of(arrays: dict[str, np.ndarray], attributes: dict[str, str]) -> str:
    """Return SHA-256 of a file's content without measured times, 64 hexadecimal digits.

    ``accuracy`` and the certificate's ``build_cpu_seconds`` are left out: two builds of one organ
    differ in nothing else.
    """
    lasting = {key: value for key, value in attributes.items() if key != "accuracy"}
    certificate = json.loads(lasting["certificate"])
    if certificate is not None:
        certificate.pop("build_cpu_seconds", None)
    return checksum(arrays, lasting | {"certificate": json.dumps(certificate)})


def _attributes_of(held: dict[str, str], origin: str) -> dict[str, str]:
    """Return the attributes to verify, for a vademecum of the present schema."""
    if held.get("format") != FORMAT:
        raise StorageError(f"{origin} is HDF5 but no vademecum; build one with 'avatar vademecum'")
    require_schema(held, SCHEMA_VERSION, origin, "build it again with 'avatar vademecum'")
    return {key: held[key] for key in ("format", "schema", "name", "element", *_JSON)}


def _arrays(v: Vademecum) -> dict[str, np.ndarray]:
    """Return every dataset; the keys are attribute paths of the vademecum."""
    arrays = {}
    held = PARAMETRIC_KEYS[:1] * bool(v.parametric) + LARGE_KEYS[:1] * bool(v.large)
    held += BODY_KEYS[:1] * bool(v.body)
    held += TUMOUR_KEYS[:1] * (v.tip_field.tumour is not None)
    held += OUTLINE_KEYS[:1] * (v.tip_field.outline is not None)
    held += DISPLAY_KEYS[:1] * bool(v.display)
    held += RESECTION_KEYS[:1] * bool(v.resection)
    held += PARAMETRIC_BODY_KEYS[:1] * bool(v.parametric and v.parametric.body)
    for key in shapes_of(held):
        value: Any = v
        for attribute in key.split("/"):
            value = getattr(value, attribute)
        arrays[key] = np.asarray(value)
    if v.supports:
        arrays[SUPPORT_KEYS[0]] = np.stack([support.faces for support in v.supports])
    return arrays | _upper_half(v)


def _upper_half(v: Vademecum) -> dict[str, np.ndarray]:
    """Return the upper half of the symmetric contact near field."""
    near, upper = v.contact_near, v.contact_near.is_upper
    count = np.bincount(near.position[upper], minlength=len(near.start) - 1)
    out = {
        "contact_near/start": np.concatenate([[0], np.cumsum(count)]).astype(np.int64),
        "contact_near/target": near.target[upper],
        "contact_near/block": near.block[upper],
    }
    if v.parametric is not None:
        out["parametric/contact_near"] = v.parametric.contact_near[:, upper]
    return out


def _attributes(v: Vademecum) -> dict[str, str]:
    curve = v.certificate.curve if v.certificate else None
    convergence = asdict(v.convergence)
    for report in convergence["enrichments"]:
        report["status"] = report["status"].value
    coordinates = [asdict(c) for c in v.parametric.coordinates] if v.parametric else []
    supports = [{"name": s.name, "stiffness": s.stiffness} for s in v.supports]
    return {
        "format": FORMAT,
        "schema": SCHEMA_VERSION,
        "name": v.name,
        "element": v.element,
        "material": json.dumps(asdict(v.material)),
        "provenance": json.dumps(asdict(v.provenance)),
        "convergence": json.dumps(convergence),
        "certificate": json.dumps(v.certificate and asdict(replace(v.certificate, curve=None))),
        "accuracy": json.dumps(curve.plain() if curve else None),
        "coordinates": json.dumps(coordinates),
        "contrast": json.dumps(v.contrast),
        "large": json.dumps(_large_attribute(v.large)),
        "parts": json.dumps(v.display.names if v.display else None),
        "supports": json.dumps(supports),
    }


def _assemble(arrays: dict[str, np.ndarray], attributes: dict[str, str]) -> Vademecum:
    """Return the vademecum from arrays and attributes of unknown origin; all are checked first."""
    require_sound(arrays)
    mirror = Mirror.of(arrays["contact_near/start"], arrays["contact_near/target"])
    plain = {key: parsed(attributes[key], key) for key in _JSON}
    supports = _supports(arrays, plain["supports"])
    return Vademecum(
        name=require_name(attributes["name"], "name"),
        mesh=TetMesh(arrays["mesh/vertices"], arrays["mesh/tets"], arrays.get(RESECTION_KEYS[0])),
        regions=Regions(arrays["regions/clamped"], arrays["regions/accessible"]),
        material=of_plain(Material, plain["material"], "material"),
        element=of_plain(Element, attributes["element"], "element"),  # type: ignore[arg-type]
        surface=LoadSurface(
            arrays["surface/centers"],
            arrays["surface/normals"],
            arrays["surface/corners"],
            arrays["surface/vertices"],
            float(arrays["surface/patch_radius"]),
        ),
        far=SeparatedField(arrays["far/space"], arrays["far/load"]),
        blocks=Blocks(arrays["blocks/vertex"]),
        field=_field(arrays, "field"),
        trailing=arrays["trailing"],
        contact_near=LocalBlocks(
            mirror.start, mirror.target, mirror.whole(arrays["contact_near/block"])
        ),
        tip_field=_tip_field(arrays, plain["contrast"]),
        convergence=of_plain(Convergence, plain["convergence"], "convergence"),
        provenance=of_plain(Provenance, plain["provenance"], "provenance"),
        certificate=_certificate(plain["certificate"], plain["accuracy"]),
        parametric=_parametric(arrays, plain["coordinates"], mirror, supports),
        contrast=_contrast(plain["contrast"]),
        supports=supports,
        resection=_resection(arrays),
        large=_large(arrays, plain["large"]),
        body=_body(arrays, BODY_KEYS),
        display=_display(arrays, plain["parts"]),
    )


def _display(arrays: dict[str, np.ndarray], stored: Any) -> Display | None:
    if DISPLAY_KEYS[0] not in arrays:
        return None
    names = of_plain(tuple[str, ...], stored, "parts")
    if len(names) + 1 != len(arrays["display/first_face"]) or names[0] != ORGAN:
        raise StorageError("'parts' do not fit 'display/first_face'; build the file again")
    for name in names:
        require_name(name, "parts")
    vertices, faces, corners, weights, first_face = (arrays[key] for key in DISPLAY_KEYS)
    return Display(vertices, faces, corners, weights, first_face, names)


def _field(arrays: dict[str, np.ndarray], name: str) -> BlockField:
    return BlockField(*(arrays[f"{name}/{one.name}"] for one in fields(BlockField)))


def _tip_field(arrays: dict[str, np.ndarray], contrast: Any) -> TipField:
    field = TipField(*(arrays.get(f"tip_field/{name}") for name in TipField._fields))
    if field.tumour is not None and contrast is None:
        raise StorageError("the tumour has no 'contrast'; build the file again")
    if OUTLINE_KEYS[0] not in arrays:
        return field
    return field._replace(outline=Outline(*(arrays[key] for key in OUTLINE_KEYS)))


def _body(arrays: dict[str, np.ndarray], keys: tuple[str, ...]) -> BodyResponse | None:
    return BodyResponse(*(arrays[key] for key in keys)) if keys[0] in arrays else None


def _contrast(stored: Any) -> float | None:
    contrast = of_plain(float | None, stored, "contrast")  # type: ignore[arg-type]
    if contrast is not None and not (math.isfinite(contrast) and contrast > 0.0):
        raise StorageError(f"'contrast' is {contrast:g}, not above 0; build the file again")
    return contrast


@dataclass(frozen=True)
class _Support:
    """Stored data of a support beside its faces."""

    name: str
    stiffness: float


def _supports(arrays: dict[str, np.ndarray], stored: Any) -> tuple[Support, ...]:
    if SUPPORT_KEYS[0] not in arrays:
        return ()
    said, faces = of_plain(tuple[_Support, ...], stored, "supports"), arrays[SUPPORT_KEYS[0]]
    if len(said) != len(faces) or len({one.name for one in said}) < len(said):
        raise StorageError("'supports' do not fit 'supports/faces'; build the file again")
    return tuple(
        Support(require_name(one.name, "supports"), some, one.stiffness)
        for one, some in zip(said, faces, strict=True)
    )


def _resection(arrays: dict[str, np.ndarray]) -> Resection | None:
    if RESECTION_KEYS[0] not in arrays:
        return None
    direction, fronts, opened, stiffness, halfway = (
        arrays[key].astype(float).tolist() for key in RESECTION_KEYS[1:]
    )
    return Resection(tuple(direction), tuple(fronts), opened, stiffness, halfway)


def _certificate(stored: Any, curve: Any) -> Certificate | None:
    certificate = of_plain(Certificate | None, stored, "certificate")  # type: ignore[arg-type]
    if certificate is None or curve is None:
        return certificate
    columns = asdict(of_plain(_Curve, curve, "accuracy"))
    if len({len(column) for column in columns.values() if isinstance(column, tuple)}) != 1:
        raise StorageError("'accuracy' has columns of several lengths; build the file again")
    return replace(certificate, curve=AccuracyCurve.of_plain(columns))


@dataclass(frozen=True)
class _Curve:
    """Stored data of an accuracy curve, see AccuracyCurve.plain()."""

    modes: tuple[int, ...]
    cloud: tuple[Cloud, ...]
    l2: tuple[float, ...]
    force: tuple[float, ...]
    nbytes: tuple[int, ...]
    p50: tuple[float, ...]
    p99: tuple[float, ...]
    n_errors: int
    machine: str


@dataclass(frozen=True)
class _Large:
    """Stored data of large deformation beside its arrays."""

    material: LargeMaterial
    certificate: LargeCertificate | None


def _large_attribute(large: LargeDeformation | None) -> dict[str, Any] | None:
    if large is None:
        return None
    certificate = asdict(large.certificate) if large.certificate else None
    return {"material": large.material, "certificate": certificate}


def _large(arrays: dict[str, np.ndarray], stored: Any) -> LargeDeformation | None:
    if LARGE_KEYS[0] not in arrays:
        return None
    said = of_plain(_Large, stored, "large")
    terms = _field(arrays, "large/terms")
    depth, reach = arrays["large/depth"], arrays["large/reach"]
    return LargeDeformation(said.material, terms, depth, reach, said.certificate)


def _parametric(
    arrays: dict[str, np.ndarray], stored: Any, mirror: Mirror, supports: Sequence[Support]
) -> ParametricResponse | None:
    if PARAMETRIC_KEYS[0] not in arrays:
        return None
    part = {key.removeprefix("parametric/"): arrays[key] for key in PARAMETRIC_KEYS}
    coordinates = of_plain(tuple[Coordinate, ...], stored, "coordinates")
    n_nodes = math.prod(coordinate.n_nodes for coordinate in coordinates)
    if not coordinates or n_nodes != len(part["contact_near"]):
        raise StorageError(
            "'coordinates' do not fit 'parametric/contact_near'; build the file again"
        )
    held = {SUPPORT + support.name for support in supports}
    if not {c.name for c in coordinates if c.kind == "support"} <= held:
        raise StorageError("'coordinates' do not fit 'supports'; build the file again")
    if any(c.kind == RESECTION for c in coordinates) and RESECTION_KEYS[0] not in arrays:
        raise StorageError("'coordinates' do not fit 'resection'; build the file again")
    return ParametricResponse(
        coordinates=coordinates,
        basis=SeparatedField(part["basis/space"], part["basis/load"]),
        operators=part["operators"],
        projection=part["projection"],
        regional_load=part["regional_load"],
        core=part["core"],
        contact_near=mirror.whole(part["contact_near"]),
        n_global=int(part["n_global"]),
        rank=int(part["rank"]),
        young_modulus=Material(float(part["young_modulus"])).young_modulus,
        body=_body(arrays, PARAMETRIC_BODY_KEYS),
    )
