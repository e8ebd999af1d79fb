"""The L2 norm by lumped masses."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.fem.norms import l2_norm, relative_l2
from avatar_core.geometry.mesh import TetMesh


def test_a_unit_translation_has_the_root_of_the_volume(phantom_mesh: TetMesh) -> None:
    translation = np.tile(np.eye(3), (len(phantom_mesh.vertices), 1))
    norm = l2_norm(translation, phantom_mesh.lumped_mass)
    np.testing.assert_allclose(norm, 3 * [np.sqrt(phantom_mesh.volume)], rtol=1e-12)


@pytest.mark.parametrize("shape", [(30,), (30, 4), (30, 4, 3)])
def test_relative_errors_are_those_of_each_column(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    truth, mass = rng.standard_normal(shape), rng.uniform(0.5, 2.0, 30)
    scale = rng.uniform(-0.5, 0.5, shape[1:])
    np.testing.assert_allclose(relative_l2((1.0 + scale) * truth, truth, mass), np.abs(scale))
