"""What the patient node asks of its worker process, and what that reports: pickled objects."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar_core.errors import AvatarError
from avatar_core.geometry.surface_formats import LABEL_MAPS

# Regions of a face of a preview, as in BuildPatient.action; springs are numbered from the last on.
FREE, CLAMPED, ACCESSIBLE, FIRST_SPRING = range(4)


class BuildError(AvatarError):
    """A patient's vademecum was not built."""


class BusyError(BuildError):
    """Another one is being built."""


class CancelledError(BuildError):
    """It was cancelled before anything was written."""


@dataclass(frozen=True)
class BuildSettings:
    """What is the same for all patients of a node.

    atlas : path
    n_vertices : of a patient's mesh
    max_modes, weighting : see PatientOptions
    n_certified : unseen loads of the certificate; -1 for the default of the fidelity
    """

    atlas: str
    n_vertices: int
    max_modes: int
    weighting: str
    n_certified: int


@dataclass(frozen=True, eq=False)
class PatientRequest:
    """One patient; all paths are absolute.

    surface : file, or empty if there are vertices, shape (n, 3) [m], and faces, shape (m, 3)
    unit, axes : of the file; axes None for those that it states, else RAS
    label, inside : of a label map, the organ and what lies inside; label None for the only one
    groups : file of clamped, accessible and held points; empty for the template's
    supports : as on the command line; empty for the clamp
    preview : only register, mesh and clamp
    interpolated_first : write an interpolated vademecum to the file, before a better one
    neighbors : 0 for all
    tolerance : 0 for the default
    output : file to write
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
    """The finished ``fraction`` of a ``stage``, and the ``error`` so far (NaN: unknown).

    file : interpolated vademecum that was written first; empty if there is none
    """

    stage: str
    fraction: float
    error: float
    file: str = ""


@dataclass(frozen=True)
class Ready:
    """The atlas is loaded; so many of its anatomies have a response."""

    n_anatomies: int


@dataclass(frozen=True)
class BuildRefused:
    """Nothing was written, for this reason."""

    reason: str


@dataclass(frozen=True, eq=False)
class Previewed:
    """The surface of a patient's mesh and its regions; nothing was written.

    vertices : ndarray, shape (n, 3) [m]; faces : (m, 3)
    regions : ndarray of uint8, shape (m,): 0 free, 1 clamped, 2 accessible, 3 on the first of the
        springs, and so on
    missed : vertices [m] and faces of the patient's own surface that the mesh does not reach
    """

    vertices: np.ndarray
    faces: np.ndarray
    regions: np.ndarray
    missed: tuple[np.ndarray, np.ndarray]
    notices: list[str]
    seconds: float = 0.0


@dataclass(frozen=True)
class Built:
    """What was written; fields as in InterpolatePatient.srv."""

    vademecum_id: str
    file: str
    neighbours: list[str]
    weights: list[float]
    weight_abs_sum: float
    hull_distance: float
    volume_error: float
    displacement_error: float
    notices: list[str]
    seconds: float = 0.0


def stem(name: str) -> str:
    """The name of a surface's or a label map's file without its suffix, and with all other dots.

    Two studies called 1.2.840.17.nii.gz and 1.2.840.18.nii.gz are not one patient.
    """
    ends = sorted((*LABEL_MAPS, *(f".seg{end}" for end in LABEL_MAPS)), key=len)
    found = [end for end in ends if name.lower().endswith(end)]
    return name[: -len(found[-1])] if found else Path(name).stem
