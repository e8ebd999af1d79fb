"""Data of the studies: folders of livers, scans of the same person, and the grid of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import SurfaceError
from avatar_core.geometry.level_set import DistanceGrid, GridBox, distance_grid, distance_in_box
from avatar_core.geometry.phantom import phantom_liver, population
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.geometry.surface_formats import MESHES
from avatar_core.studies.study import follow

DEFAULT_FOLDER = Path("../shared/data/livers")

PAPER_GRID = (43, 31, 37)  # 49,321 values
PADDING = 0.02  # margin of the common box beyond all organs [m]

# Scans of one person under several names (LiTS). They must never be on both sides of a split.
SAME_SUBJECT = (
    ("LiTS-6", "LiTS-7", "LiTS-8", "LiTS-9", "LiTS-10"),
    ("LiTS-14", "LiTS-15"),
    ("LiTS-19", "LiTS-20"),
)

PHANTOM_BEND = 0.02  # [m] of the population that stands in for real livers


@dataclass(frozen=True, eq=False)
class Livers:
    """Surfaces of a study.

    surfaces : in alphabetical order of their names
    subjects : ndarray of int, shape (n,), equal for scans of one person
    notices : files that were skipped, and what replaced missing ones
    """

    surfaces: tuple[SurfaceMesh, ...]
    subjects: IntArray
    notices: tuple[str, ...]


def read_livers(folder: Path | None, n: int | None, phantoms: int) -> Livers:
    """Return the surfaces of a folder: all, or n evenly chosen ones.

    folder : None for ../shared/data/livers, or bent phantoms if that does not exist
    n : maximum number; None for all
    phantoms : number that replace a missing folder

    Raises SurfaceError if the folder does not exist or holds fewer than three surfaces.
    """
    if folder is None and not DEFAULT_FOLDER.is_dir():
        maps = population(phantoms, seed=1, bend=PHANTOM_BEND)
        organ = phantom_liver(spacing=0.01)
        moved = [replace(m.moved(organ), name=f"phantom-{i}") for i, m in enumerate(maps)]
        notice = f"no folder {DEFAULT_FOLDER}: {phantoms} bent phantoms stand in for real livers"
        return Livers(tuple(moved), np.arange(phantoms), (notice,))
    folder = folder or DEFAULT_FOLDER
    if not folder.is_dir():
        raise SurfaceError(f"{folder} is no folder; give one with surfaces of livers")
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in MESHES)
    if n is not None and len(files) > n:
        files = [files[i] for i in np.linspace(0, len(files) - 1, n).astype(int)]
    surfaces, notices = [], []
    for file in follow(files, "reading"):
        try:
            surfaces.append(read_surface(file))
        except SurfaceError as error:
            notices.append(f"skipped {error}")
    if len(surfaces) < 3:
        raise SurfaceError(
            f"{folder} holds {len(surfaces)} readable surface(s); a study needs at least 3"
        )
    names = [Path(surface.name).stem for surface in surfaces]
    return Livers(tuple(surfaces), subject_numbers(names), tuple(notices))


def read_liver(folder: Path | None, name: str) -> SurfaceMesh:
    """Return one liver of a folder, else the first; the phantom without a folder.

    folder : None for ../shared/data/livers
    """
    if folder is None and not DEFAULT_FOLDER.is_dir():
        return phantom_liver()
    livers = sorted((folder or DEFAULT_FOLDER).glob("*.obj"))
    if not livers:
        raise SurfaceError(f"no .obj files in {folder}; give a folder of liver surfaces")
    return read_surface(next((path for path in livers if path.stem == name), livers[0]))


def subject_numbers(names: Sequence[str]) -> IntArray:
    """Return the number of the person of each scan, shape (n,)."""
    person = {name: scans[0] for scans in SAME_SUBJECT for name in scans}
    _, number = np.unique([person.get(name, name) for name in names], return_inverse=True)
    return number.astype(np.int64)


def paper_box(surfaces: Sequence[SurfaceMesh], shape: tuple[int, int, int]) -> GridBox:
    """Return a box around all surfaces, with equal spacing and numbers of points by axis."""
    low = np.min([surface.bounding_box[0] for surface in surfaces], axis=0)
    high = np.max([surface.bounding_box[1] for surface in surfaces], axis=0)
    cells = np.array(shape) - 1
    spacing = float(((high - low + 2 * PADDING) / cells).max())
    x, y, z = (float(value) for value in (low + high - spacing * cells) / 2)
    return GridBox((x, y, z), spacing, shape)


def distance_vectors(surfaces: Sequence[SurfaceMesh], box: GridBox) -> FloatArray:
    """Return signed distances of all surfaces at the points of the box, shape (n, n_points) [m]."""
    vectors = np.empty((len(surfaces), int(np.prod(box.shape))))
    for row, surface in zip(vectors, follow(surfaces, "distance fields"), strict=True):
        row[:] = distance_in_box(surface, box).values.ravel()
    return vectors


def as_grid(vector: FloatArray, box: GridBox) -> DistanceGrid:
    """Return a vector of distances back on its grid."""
    return DistanceGrid(np.array(box.origin), box.spacing, vector.reshape(box.shape))


def centred(surface: SurfaceMesh) -> SurfaceMesh:
    """Return the surface with its centroid of volume at the origin."""
    grid = distance_grid(surface, spacing=float(surface.extent.max()) / 24, padding=0.0)
    middle = grid.points[grid.values.ravel() < 0].mean(axis=0)
    return replace(surface, vertices=surface.vertices - middle)
