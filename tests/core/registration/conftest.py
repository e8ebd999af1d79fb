"""True deformations that several tests share."""

from __future__ import annotations

import pytest

from avatar_core.geometry.mesh import TetMesh
from avatar_core.studies.registration_truth import Truth


@pytest.fixture(scope="module")
def truth(phantom_mesh: TetMesh) -> Truth:
    """Deform another mesh than the vademecum's, 700 vertices for 900."""
    return Truth.on(phantom_mesh)
