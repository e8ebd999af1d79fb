"""Tetrahedra: an organ is filled, and wholly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avatar_core.errors import MeshError
from avatar_core.geometry.mesh import tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.vademecum.model import Vademecum
from tests.recorded_meshes import N_VERTICES


@pytest.mark.long
def test_a_real_liver_keeps_its_lobes(real_vademecum: Vademecum, livers_dir: Path) -> None:
    """fTetWild's own filter dropped up to a third of Amos-007, in one run of four."""
    surface = read_surface(livers_dir / f"{real_vademecum.name}.obj")
    assert real_vademecum.mesh.volume == pytest.approx(surface.volume, rel=0.02)


@pytest.mark.long
def test_a_mesh_that_lacks_a_part_of_the_organ_is_refused() -> None:
    organ = phantom_liver(12e-3)
    apart = organ.vertices + np.array([0.5, 0.0, 0.0])
    both = SurfaceMesh(
        np.vstack([organ.vertices, apart]), np.vstack([organ.faces, organ.faces + len(apart)])
    )
    with pytest.raises(MeshError, match="49% of the volume"):
        tetrahedralize(both, 1000)


@pytest.mark.parametrize(("spacing", "n"), [(h, n) for h in N_VERTICES for n in N_VERTICES[h]])
def test_the_built_in_liver_has_the_same_mesh_at_any_scale(spacing: float, n: int) -> None:
    """Filled anew, no two are the same: then figures of other tests would change with each run."""
    liver = phantom_liver(spacing)
    mesh = tetrahedralize(liver, n)
    again = tetrahedralize(replace(liver, vertices=10.0 * liver.vertices), n)
    np.testing.assert_array_equal(again.tets, mesh.tets)
    np.testing.assert_allclose(again.vertices, 10.0 * mesh.vertices, rtol=0.0, atol=1e-9)
    assert mesh.volume == pytest.approx(liver.volume, rel=0.03)
