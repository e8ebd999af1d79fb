"""Tetrahedra: an organ is filled, and wholly."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from avatar_core.errors import MeshError
from avatar_core.mesh import tetrahedralize
from avatar_core.phantom import phantom_liver
from avatar_core.surface import SurfaceMesh, read_surface
from avatar_core.vademecum import Vademecum


@pytest.mark.long
def test_a_real_liver_keeps_its_lobes(real_vademecum: Vademecum, livers_dir: Path) -> None:
    """fTetWild's own filter dropped up to a third of Amos-007, in one run of four."""
    surface = read_surface(livers_dir / f"{real_vademecum.name}.obj")
    assert real_vademecum.mesh.volume == pytest.approx(surface.volume, rel=0.02)


def test_a_mesh_that_lacks_a_part_of_the_organ_is_refused() -> None:
    organ = phantom_liver(12e-3)
    apart = organ.vertices + np.array([0.5, 0.0, 0.0])
    both = SurfaceMesh(
        np.vstack([organ.vertices, apart]),
        np.vstack([organ.faces, organ.faces + len(apart)]),
    )
    with pytest.raises(MeshError, match="49% of the volume"):
        tetrahedralize(both, 1000)
