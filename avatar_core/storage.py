"""Vademecums on disk: HDF5 with schema version and checksum.

Layout (schema 2.2), attributes at the root: ``format`` = "avatar vademecum", ``schema``,
``name``, ``element``, ``checksum`` (SHA-256 over names, types, shapes and bytes of all datasets
in sorted order and over the JSON attributes), and the JSON attributes ``material``,
``provenance``, ``convergence``, ``certificate``, and from schema 2.2 ``accuracy``, its curve.
Datasets:

    mesh/vertices (n_v, 3) [m]          mesh/tets (n_t, 4)
    regions/clamped, regions/accessible over the boundary faces
    surface/centers, surface/normals (n_s, 3) [m]   surface/corners (n_f, 3)
    surface/vertices                     surface/patch_radius [m]
    far/space (3 n_v, k) [m]             far/load (3 n_s, k)
    near/start, near/target, near/block [m/N]
    contact_near/start, contact_near/target, contact_near/block [m/N]
    tip_field/distance, tip_field/access, tip_field/origin, tip_field/spacing [m]

A vademecum with coordinates of the material (from schema 2.0) has
the JSON attributes ``coordinates``, ``contrast``, and

    parametric/basis/space (3 n_v, n)    parametric/basis/load (3 n_s, n)
    parametric/operators (n_terms, n, n) parametric/rank, parametric/young_modulus [Pa]
    parametric/near, parametric/contact_near (n_nodes, n_blocks, 3, 3) [m/N]

one that knows the organ's mass (from schema 2.1) body/mass (rank, rank) and body/weight (rank, 3),
and the same under parametric/body for that basis; one with large deformation the JSON attribute
``large`` (material, certificate) and, for k = 2, 3,

    large/space (3 n_v, n)               large/load (2, n_s, n) [m^(1-k)]
    large/near (2, n_blocks, 3) [m^(1-k)], in the pattern of near/
    large/depth (2, n_s) [m^(1-k)]       large/reach (n_s,) [m]
"""

from __future__ import annotations

import hashlib
import io
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from avatar_core.accuracy import AccuracyCurve
from avatar_core.body import BodyResponse
from avatar_core.certificate import Certificate
from avatar_core.coordinates import Coordinate
from avatar_core.elasticity import Material
from avatar_core.errors import AvatarError, StorageError
from avatar_core.force_error import ForceError
from avatar_core.hdf5 import checksum, reason, replace_file, within
from avatar_core.large_deformation import POWERS, LargeCertificate, LargeDeformation
from avatar_core.loads import LoadSurface
from avatar_core.mesh import Regions, TetMesh
from avatar_core.near_field import LocalBlocks
from avatar_core.parametric import ParametricResponse
from avatar_core.pgd_load import EnrichmentReport, EnrichmentStatus
from avatar_core.separated import SeparatedField
from avatar_core.tip_field import TipField
from avatar_core.vademecum import (
    SCHEMA_VERSION,
    Convergence,
    Provenance,
    RankError,
    Vademecum,
)

FORMAT = "avatar vademecum"
MAX_FILE_BYTES = 4 << 30
MAX_ARRAY_BYTES = 2 << 30

_JSON = ("material", "provenance", "convergence", "certificate")
_JSON_LATER = ("coordinates", "contrast", "large", "accuracy")  # from schema 2.0, the last 2.2


def save_vademecum(vademecum: Vademecum, path: str | Path) -> None:
    """Write a vademecum; the file appears complete or not at all.

    Raises
    ------
    StorageError
        If the folder does not exist or the disk is full; nothing is left behind.
    """
    replace_file(Path(path), _arrays(vademecum), _attributes(vademecum))


def load_vademecum(path: str | Path) -> Vademecum:
    """Read and verify a vademecum.

    Sizes are checked before anything is allocated, the checksum before anything is used.

    Raises
    ------
    StorageError
        For a missing, truncated, altered, foreign or newer file.
    """
    path = Path(path)
    if not path.is_file():
        raise StorageError(f"no vademecum at {path}; build one with 'avatar vademecum'")
    return _read(path, path.stat().st_size, str(path), file_id(path))


def parse_vademecum(content: bytes | memoryview, origin: str) -> Vademecum:
    """Read and verify a vademecum in memory; see :func:`load_vademecum`.

    Parameters
    ----------
    content : the bytes of a vademecum file
    origin : what messages call it
    """
    digest = hashlib.sha256(content).hexdigest()
    return _read(io.BytesIO(content), len(content), origin, digest)


def _read(source: Path | io.BytesIO, size: int, origin: str, identity: str) -> Vademecum:
    if size > MAX_FILE_BYTES:
        raise StorageError(f"{origin} has {size >> 20} MiB, more than a vademecum may have")
    try:
        with h5py.File(source, "r") as file:
            attributes = _read_attributes(file, origin)
            arrays = _read_arrays(file, origin, size)
            stated = str(file.attrs["checksum"])
        if stated != checksum(arrays, attributes):
            raise StorageError(f"{origin} was altered or damaged (checksum); build it again")
        vademecum = _assemble(arrays, attributes)
    except AvatarError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, IndexError) as error:
        raise StorageError(
            f"{origin} is no readable vademecum ({reason(error)}); it may be truncated: "
            "build or copy it again"
        ) from error
    return replace(vademecum, id=identity, nbytes=size)


def file_id(path: str | Path) -> str:
    """SHA-256 of the file, the id under which a vademecum is announced."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def _read_attributes(file: h5py.File, path: str) -> dict[str, str]:
    if str(file.attrs.get("format", "")) != FORMAT:
        raise StorageError(f"{path} is HDF5 but no vademecum; build one with 'avatar vademecum'")
    schema = str(file.attrs["schema"])
    if int(schema.split(".")[0]) > int(SCHEMA_VERSION.split(".")[0]):
        raise StorageError(
            f"{path} has schema {schema}, this version reads up to {SCHEMA_VERSION}; upgrade avatar"
        )
    keys = ("format", "schema", "name", "element", *_JSON)
    optional = tuple(key for key in _JSON_LATER if key in file.attrs)
    return {key: str(file.attrs[key]) for key in keys + optional}


def _read_arrays(file: h5py.File, path: str, size: int) -> dict[str, np.ndarray]:
    arrays: dict[str, np.ndarray] = {}
    total = 0
    keys = _KEYS + (_PARAMETRIC_KEYS if "parametric" in file else ())
    keys += _LARGE_KEYS if "large" in file else ()
    keys += _BODY_KEYS if "body" in file else ()
    keys += _PARAMETRIC_BODY_KEYS if "parametric/body" in file else ()
    for key in keys:
        dataset = file[key]
        if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "fiub":
            raise StorageError(f"{path}: '{key}' is no array of numbers; build the file again")
        if dataset.is_virtual or dataset.external:
            raise StorageError(f"{path}: '{key}' points outside the file; build it again")
        total += dataset.nbytes
        if dataset.nbytes > MAX_ARRAY_BYTES or total > size:
            raise StorageError(f"{path}: '{key}' claims more data than the file holds")
        arrays[key] = dataset[...]
    return arrays


_KEYS = (
    "mesh/vertices",
    "mesh/tets",
    "regions/clamped",
    "regions/accessible",
    "surface/centers",
    "surface/normals",
    "surface/corners",
    "surface/vertices",
    "surface/patch_radius",
    "far/space",
    "far/load",
    "near/start",
    "near/target",
    "near/block",
    "contact_near/start",
    "contact_near/target",
    "contact_near/block",
    "tip_field/distance",
    "tip_field/access",
    "tip_field/origin",
    "tip_field/spacing",
)
_PARAMETRIC_KEYS = (
    "parametric/basis/space",
    "parametric/basis/load",
    "parametric/operators",
    "parametric/rank",
    "parametric/young_modulus",
    "parametric/near",
    "parametric/contact_near",
)
_BODY_KEYS = ("body/mass", "body/weight")
_PARAMETRIC_BODY_KEYS = ("parametric/body/mass", "parametric/body/weight")
_LARGE_KEYS = ("large/space", "large/load", "large/near", "large/depth", "large/reach")


def _arrays(v: Vademecum) -> dict[str, np.ndarray]:
    """Every dataset; the keys are attribute paths of the vademecum."""
    arrays = {}
    keys = _KEYS + (_PARAMETRIC_KEYS if v.parametric else ()) + (_LARGE_KEYS if v.large else ())
    keys += _BODY_KEYS if v.body else ()
    keys += _PARAMETRIC_BODY_KEYS if v.parametric and v.parametric.body else ()
    for key in keys:
        value: Any = v
        for attribute in key.split("/"):
            value = getattr(value, attribute)
        arrays[key] = np.asarray(value)
    return arrays


def _attributes(v: Vademecum) -> dict[str, str]:
    curve = v.certificate.curve if v.certificate else None
    convergence = asdict(v.convergence)
    for report in convergence["enrichments"]:
        report["status"] = report["status"].value
    coordinates = [asdict(c) for c in v.parametric.coordinates] if v.parametric else []
    return {
        "format": FORMAT,
        "schema": SCHEMA_VERSION,
        "name": v.name,
        "element": v.element,
        "material": json.dumps(asdict(v.material)),
        "provenance": json.dumps(asdict(v.provenance)),
        "convergence": json.dumps(convergence),
        "certificate": json.dumps(_certificate_attribute(v.certificate)),
        "accuracy": json.dumps(curve.plain() if curve else None),
        "coordinates": json.dumps(coordinates),
        "contrast": json.dumps(v.contrast),
        "large": json.dumps(_large_attribute(v.large)),
    }


def _assemble(arrays: dict[str, np.ndarray], attributes: dict[str, str]) -> Vademecum:
    _check_shapes(arrays)
    material, provenance, convergence, certificate = (json.loads(attributes[k]) for k in _JSON)

    def blocks(name: str) -> LocalBlocks:
        return LocalBlocks(*(arrays[f"{name}/{k}"] for k in ("start", "target", "block")))

    return Vademecum(
        name=attributes["name"],
        mesh=TetMesh(arrays["mesh/vertices"], arrays["mesh/tets"]),
        regions=Regions(arrays["regions/clamped"], arrays["regions/accessible"]),
        material=Material(**material),
        element=attributes["element"],  # type: ignore[arg-type]
        surface=LoadSurface(
            arrays["surface/centers"],
            arrays["surface/normals"],
            arrays["surface/corners"],
            arrays["surface/vertices"],
            float(arrays["surface/patch_radius"]),
        ),
        far=SeparatedField(arrays["far/space"], arrays["far/load"]),
        near=blocks("near"),
        contact_near=blocks("contact_near"),
        tip_field=TipField(*(arrays[f"tip_field/{name}"] for name in TipField._fields)),
        convergence=_convergence(convergence),
        provenance=_provenance(provenance),
        certificate=_certificate(certificate, json.loads(attributes.get("accuracy", "null"))),
        parametric=_parametric(arrays, attributes),
        contrast=json.loads(attributes.get("contrast", "null")),
        large=_large(arrays, attributes),
        body=_body(arrays, _BODY_KEYS),
    )


def _body(arrays: dict[str, np.ndarray], keys: tuple[str, str]) -> BodyResponse | None:
    return BodyResponse(*(arrays[key] for key in keys)) if keys[0] in arrays else None


def _certificate_attribute(certificate: Certificate | None) -> dict[str, Any] | None:
    return asdict(replace(certificate, curve=None)) if certificate else None


def _certificate(stored: dict[str, Any] | None, curve: dict[str, Any] | None) -> Certificate | None:
    if stored is None:
        return None
    values = dict(stored)
    if "force_error" in values:
        values["force_error"] = ForceError(**values["force_error"])
    values["curve"] = AccuracyCurve.of_plain(curve) if curve else None
    return Certificate(**values)


def _large_attribute(large: LargeDeformation | None) -> dict[str, Any] | None:
    if large is None:
        return None
    certificate = asdict(large.certificate) if large.certificate else None
    return {"material": large.material, "certificate": certificate}


def _large(arrays: dict[str, np.ndarray], attributes: dict[str, str]) -> LargeDeformation | None:
    if "large/space" not in arrays:
        return None
    stored = json.loads(attributes["large"])
    certificate = LargeCertificate(**stored["certificate"]) if stored["certificate"] else None
    space, load, near, depth, reach = (arrays[key] for key in _LARGE_KEYS)
    return LargeDeformation(stored["material"], space, load, near, depth, reach, certificate)


def _parametric(
    arrays: dict[str, np.ndarray], attributes: dict[str, str]
) -> ParametricResponse | None:
    if "parametric/basis/space" not in arrays:
        return None
    part = {key.removeprefix("parametric/"): arrays[key] for key in _PARAMETRIC_KEYS}
    return ParametricResponse(
        coordinates=tuple(Coordinate(**c) for c in json.loads(attributes["coordinates"])),
        basis=SeparatedField(part["basis/space"], part["basis/load"]),
        operators=part["operators"],
        near=part["near"],
        contact_near=part["contact_near"],
        rank=int(part["rank"]),
        young_modulus=float(part["young_modulus"]),
        body=_body(arrays, _PARAMETRIC_BODY_KEYS),
    )


def _provenance(stored: dict[str, Any]) -> Provenance:
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in stored.items()}
    return Provenance(**values)


def _convergence(stored: dict[str, Any]) -> Convergence:
    return Convergence(
        stored["converged"],
        stored["tolerance"],
        tuple(
            EnrichmentReport(**{**report, "status": EnrichmentStatus(report["status"])})
            for report in stored["enrichments"]
        ),
        tuple(RankError(**error) for error in stored["rank_errors"]),
    )


def _check_shapes(a: dict[str, np.ndarray]) -> None:
    """Indices within bounds and sizes that agree, so that compiled code cannot go astray."""
    n_vertices, n_positions = len(a["mesh/vertices"]), len(a["surface/centers"])
    rank = a["far/space"].shape[1]
    agree = (
        a["far/space"].shape == (3 * n_vertices, rank)
        and a["far/load"].shape == (3 * n_positions, rank)
        and a["surface/normals"].shape == (n_positions, 3)
        and a["tip_field/distance"].shape == a["tip_field/access"].shape
        and a["tip_field/origin"].shape == (3,)
        and all(np.isfinite(v).all() for v in a.values() if v.dtype.kind == "f")
    )
    for name, target in (("near", n_vertices), ("contact_near", n_positions)):
        start, index = a[f"{name}/start"], a[f"{name}/target"]
        agree = agree and (
            len(start) == n_positions + 1
            and start[0] == 0
            and bool((np.diff(start) >= 0).all())
            and start[-1] == len(index)
            and a[f"{name}/block"].shape == (len(index), 3, 3)
            and within(index, target)
        )
    agree = agree and within(a["mesh/tets"], n_vertices)
    if "parametric/basis/space" in a:
        n, n_nodes = a["parametric/basis/space"].shape[1], len(a["parametric/near"])
        agree = agree and (
            a["parametric/basis/space"].shape == (3 * n_vertices, n)
            and a["parametric/basis/load"].shape == (3 * n_positions, n)
            and a["parametric/operators"].shape[1:] == (n, n)
            and a["parametric/near"].shape == (n_nodes, *a["near/block"].shape)
            and a["parametric/contact_near"].shape == (n_nodes, *a["contact_near/block"].shape)
            and 1 <= int(a["parametric/rank"]) <= n
        )
    if "large/space" in a:
        n, n_powers = a["large/space"].shape[1], len(POWERS)
        agree = agree and (
            a["large/space"].shape == (3 * n_vertices, n)
            and a["large/load"].shape == (n_powers, n_positions, n)
            and a["large/near"].shape == (n_powers, len(a["near/target"]), 3)
            and a["large/depth"].shape == (n_powers, n_positions)
            and a["large/reach"].shape == (n_positions,)
        )
    for (mass, weight), space in (
        (_BODY_KEYS, "far/space"),
        (_PARAMETRIC_BODY_KEYS, "parametric/basis/space"),
    ):
        if mass in a:
            n = a[space].shape[1]
            agree = agree and a[mass].shape == (n, n) and a[weight].shape == (n, 3)
    agree = agree and within(a["surface/corners"], n_positions)
    agree = agree and within(a["surface/vertices"], n_vertices)
    if not agree:
        raise StorageError("the arrays of the file do not fit together; build it again")
