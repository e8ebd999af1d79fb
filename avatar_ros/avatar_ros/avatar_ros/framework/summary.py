"""Announcement of a vademecum, read in the process that reads the file.

The loader itself holds neither the arrays of the vademecum nor the libraries that read them.
"""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from avatar_core.vademecum import storage


def summary(content: bytes, origin: str) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Return fields of a VademecumInfo, vertices (n, 3) [m] and faces (m, 3) of the surface.

    Raises StorageError as ``storage.parse_vademecum`` does.
    """
    vademecum = storage.parse_vademecum(content, origin)
    return asdict(vademecum.info()), vademecum.surface_vertices, vademecum.surface_faces
