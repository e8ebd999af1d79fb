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
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from avatar_core.atlas import Atlas
from avatar_core.atlas_anatomy import Anatomy, Response
from avatar_core.elasticity import Material
from avatar_core.errors import AvatarError, StorageError
from avatar_core.hdf5 import checksum, reason, replace_file, within
from avatar_core.level_set import GridBox
from avatar_core.lle import Gram
from avatar_core.mesh import MeshQuality, Regions, TetMesh
from avatar_core.registration import (
    RegistrationQuality,
    RegistrationRule,
    SimilarityTransform,
    Template,
)
from avatar_core.surface import SurfaceMesh

ATLAS_SCHEMA = "1.0"
ATLAS_FORMAT = "avatar atlas"
ANATOMY_FORMAT = "avatar anatomy"
RESPONSE_KEYS = ("space", "load", "missing")
MAX_FILE_BYTES = 64 << 30

Arrays = dict[str, np.ndarray]


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
        For a missing, truncated, altered, foreign or newer file.
    """
    path = Path(path)
    if not path.is_file():
        raise StorageError(f"no atlas at {path}; make one with 'avatar atlas create'")
    return _read(path, ATLAS_FORMAT, _atlas)


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
        arrays |= {key: getattr(response, key) for key in RESPONSE_KEYS}
        about["response"] = {
            "material": asdict(response.material),
            "element": response.element,
            "patch_radius": response.patch_radius,
        }
    return {**arrays, "about": np.frombuffer(json.dumps(about).encode(), dtype=np.uint8)}


def _anatomy(arrays: Arrays) -> Anatomy:
    _require_finite(arrays)
    about = json.loads(arrays["about"].tobytes())
    stored, quality = about["surface"], about["quality"]
    surface = SurfaceMesh(
        arrays["vertices"],
        arrays["faces"],
        stored["name"],
        stored["unit"],
        np.array(stored["axes"]),
        tuple(stored["notices"]),
        stored["source_sha256"],
    )
    alignment = about["alignment"]
    return Anatomy(
        name=about["name"],
        surface=surface,
        volume=about["volume"],
        alignment=SimilarityTransform(
            alignment["scale"], np.array(alignment["rotation"]), np.array(alignment["translation"])
        ),
        distances=arrays["distances"],
        registered=arrays["registered"],
        quality=RegistrationQuality(**{**quality, "shape": MeshQuality(**quality["shape"])}),
        converged=about["converged"],
        response=_response(arrays, about.get("response")),
    )


def _response(arrays: Arrays, about: dict[str, Any] | None) -> Response | None:
    if about is None:
        return None
    return Response(
        space=arrays["space"],
        load=arrays["load"],
        missing=arrays["missing"],
        material=Material(**about["material"]),
        element=about["element"],
        patch_radius=about["patch_radius"],
    )


def _atlas(arrays: Arrays, about: dict[str, Any]) -> Atlas:
    box = about["box"]
    return Atlas(
        template=_template(arrays, about["template"]),
        box=GridBox(tuple(box["origin"]), box["spacing"], tuple(box["shape"])),
        rule=RegistrationRule(**about["rule"]),
        anatomies=tuple(_anatomy(group) for group in _groups(arrays)),
        gram=Gram(arrays["gram/origin"], arrays["gram/products"]),
    )


def _template(arrays: Arrays, name: str) -> Template:
    part = {key: arrays[f"template/{key}"] for key in ("vertices", "tets", "clamped", "accessible")}
    _require_finite({"gram": arrays["gram/products"], **part})
    mesh = TetMesh(part["vertices"], part["tets"])
    fits = part["vertices"].shape[1:] == (3,) and part["tets"].shape[1:] == (4,)
    fits = fits and within(part["tets"], len(part["vertices"]))
    n_faces = len(mesh.boundary_faces) if fits else 0
    if not fits or not part["clamped"].shape == part["accessible"].shape == (n_faces,):
        raise StorageError("the template's arrays do not fit together; build the atlas again")
    return Template(name, mesh, Regions(part["clamped"], part["accessible"]))


def _groups(arrays: Arrays) -> Iterator[Arrays]:
    """The arrays of each anatomy, in the order of their numbers."""
    groups: dict[str, Arrays] = {}
    for key in sorted(arrays):
        if key.startswith("anatomies/"):
            _, number, name = key.split("/")
            groups.setdefault(number, {})[name] = arrays[key]
    yield from groups.values()


def _require_finite(arrays: Arrays) -> None:
    for key, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise StorageError(f"'{key}' is NaN or infinite; build the atlas again")


# --- files ------------------------------------------------------------------------------------


def _read(path: Path, kind: str, assemble: Any) -> Any:
    """What `assemble` makes of the arrays and the JSON, once both are verified."""
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise StorageError(f"{path} has {size >> 20} MiB, more than an atlas may have")
    try:
        with h5py.File(path, "r") as file:
            attributes = _read_attributes(file, kind, path)
            arrays = _read_arrays(file, path, size)
            stated = str(file.attrs["checksum"])
        if stated != checksum(arrays, attributes):
            raise StorageError(f"{path} was altered or damaged (checksum); build it again")
        return assemble(arrays, json.loads(attributes["about"]))
    except AvatarError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError, TypeError, IndexError) as error:
        raise StorageError(
            f"{path} is no readable {kind.removeprefix('avatar ')} ({reason(error)}); it may be "
            "truncated: build or copy it again"
        ) from error


def _read_attributes(file: h5py.File, kind: str, path: Path) -> dict[str, str]:
    if str(file.attrs.get("format", "")) != kind:
        raise StorageError(
            f"{path} is HDF5 but no {kind.removeprefix('avatar ')}; make one with 'avatar atlas "
            "create'"
        )
    schema = str(file.attrs["schema"])
    if int(schema.split(".")[0]) > int(ATLAS_SCHEMA.split(".")[0]):
        raise StorageError(
            f"{path} has schema {schema}, this version reads up to {ATLAS_SCHEMA}; upgrade avatar"
        )
    return {key: str(file.attrs[key]) for key in ("format", "schema", "about")}


def _read_arrays(file: h5py.File, path: Path, size: int) -> Arrays:
    """All datasets; what a file claims is weighed against its size before it is read."""
    datasets: dict[str, h5py.Dataset] = {}
    file.visititems(lambda key, item: _collect(datasets, key, item))
    total = 0
    for key, dataset in datasets.items():
        if dataset.dtype.kind not in "fiub" or dataset.is_virtual or dataset.external:
            raise StorageError(f"{path}: '{key}' is no array of numbers; build the file again")
        total += dataset.nbytes
        if total > size:
            raise StorageError(f"{path}: '{key}' claims more data than the file holds")
    return {key: dataset[...] for key, dataset in datasets.items()}


def _collect(datasets: dict[str, h5py.Dataset], key: str, item: object) -> None:
    if isinstance(item, h5py.Dataset):
        datasets[key] = item
