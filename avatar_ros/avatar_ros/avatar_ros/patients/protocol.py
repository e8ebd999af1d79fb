"""Packets between the patient node and its worker process: pickled objects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar_core.errors import AvatarError
from avatar_core.geometry.surface_formats import LABEL_MAPS

# regions of a face of a preview, as in BuildPatient.action; further springs follow the last number
FREE, CLAMPED, ACCESSIBLE, FIRST_SPRING = range(4)


class BuildError(AvatarError):
    """A patient's vademecum was not built."""


class BusyError(BuildError):
    """Another patient is being built."""


class CancelledError(BuildError):
    """The build was cancelled before anything was written."""


@dataclass(frozen=True)
class BuildSettings:
    """Settings that all patients of a node share.

    Attributes
    ----------
    atlas : str
        Path of the atlas.
    n_vertices : int
        Approximate number of vertices of a patient's mesh.
    max_modes, weighting : int, str
        As in PatientOptions.
    n_certified : int
        Unseen loads of the certificate; -1 for the default of the fidelity.
    """

    atlas: str
    n_vertices: int
    max_modes: int
    weighting: str
    n_certified: int


@dataclass(frozen=True, eq=False)
class PatientRequest:
    """One patient; all paths are absolute.

    Attributes
    ----------
    surface : str
        File; empty if arrays are given.
    vertices, faces : ndarray, shapes (n, 3) and (m, 3), optional
        Vertices [m] and triangles in place of a file.
    unit, axes : str
        Unit and axes of the file; axes None for those that it states, else RAS.
    label, inside : str, tuple of str
        Labels of the organ and of structures inside it; label None for the only one.
    groups : str
        File of clamped, accessible and held points; empty for the template's.
    supports : tuple of str
        Supports as on the command line; empty for the clamp.
    preview : bool
        Only register, mesh and clamp.
    interpolated_first : bool
        Write an interpolated vademecum to the file, before a better one.
    neighbors : int
        Number of neighbors; 0 for all.
    tolerance : float
        Tolerance; 0 for the default.
    output : str
        File to write.
    """

    surface: str
    vertices: np.ndarray | None
    faces: np.ndarray | None
    unit: str
    axes: str | None
    label: str | None
    inside: tuple[str, ...]
    groups: str
    supports: tuple[str, ...]
    preview: bool
    interpolated_first: bool
    leave_out: tuple[str, ...]
    neighbors: int
    fidelity: str
    tolerance: float
    name: str
    output: str


@dataclass(frozen=True)
class Stage:
    """Progress: the finished ``fraction`` of a ``stage``, and the ``error`` so far (NaN: unknown).

    file : interpolated vademecum that was written first; empty if there is none
    """

    stage: str
    fraction: float
    error: float
    file: str = ""


@dataclass(frozen=True)
class Ready:
    """Report that the atlas is loaded, with the number of anatomies that have a response."""

    n_anatomies: int


@dataclass(frozen=True)
class BuildRefused:
    """Report that nothing was written, with the reason."""

    reason: str


@dataclass(frozen=True, eq=False)
class Previewed:
    """The surface of a patient's mesh and its regions; nothing was written.

    Attributes
    ----------
    vertices, faces : ndarray, shapes (n, 3) and (m, 3)
        Vertices [m] and triangles.
    regions : ndarray of uint8, shape (m,)
        0 free, 1 clamped, 2 accessible, 3 on the first of the springs, and so on.
    missed : tuple of ndarray
        Vertices [m] and faces of the patient's own surface that the mesh does not reach.
    """

    vertices: np.ndarray
    faces: np.ndarray
    regions: np.ndarray
    missed: tuple[np.ndarray, np.ndarray]
    notices: list[str]
    seconds: float = 0.0


@dataclass(frozen=True)
class Built:
    """Report of a written vademecum; fields as in InterpolatePatient.srv."""

    vademecum_id: str
    file: str
    neighbors: list[str]
    weights: list[float]
    weight_abs_sum: float
    hull_distance: float
    volume_error: float
    displacement_error: float
    notices: list[str]
    seconds: float = 0.0


def stem(name: str) -> str:
    """Return the name of a file of a surface or label map without suffix, keeping all other dots.

    For example, 1.2.840.17.nii.gz and 1.2.840.18.nii.gz are two patients.
    """
    ends = sorted((*LABEL_MAPS, *(f".seg{end}" for end in LABEL_MAPS)), key=len)
    found = [end for end in ends if name.lower().endswith(end)]
    return name[: -len(found[-1])] if found else Path(name).stem
