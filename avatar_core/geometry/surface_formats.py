"""The files that may hold an organ's surface, by their suffixes.

Commands, messages and folders that are searched take the names from here; help texts do so
without loading a reader. :mod:`avatar_core.geometry.surface_files` reads meshes, and
:mod:`avatar_core.geometry.label_files` label maps.
"""

from __future__ import annotations

MESHES = (".obj", ".stl", ".ply", ".vtk", ".vtp", ".off")
LABEL_MAPS = (".nii", ".nii.gz", ".nrrd", ".dcm")  # of DICOM, segmentations
SUFFIXES = (*MESHES, *LABEL_MAPS)

MESH_NAMES = ", ".join(suffix[1:].upper() for suffix in MESHES)
LABEL_MAP_NAMES = ", ".join(LABEL_MAPS)
