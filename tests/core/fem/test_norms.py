"""The L2 norm by lumped masses."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.errors import ConvergenceError
from avatar_core.fem.norms import l2_norm, mean_strain, relative_l2, require_orthonormal
from avatar_core.geometry.mesh import TetMesh


def test_a_unit_translation_has_the_root_of_the_volume(phantom_mesh: TetMesh) -> None:
    translation = np.tile(np.eye(3), (len(phantom_mesh.vertices), 1))
    norm = l2_norm(translation, phantom_mesh.lumped_mass)
    np.testing.assert_allclose(norm, 3 * [np.sqrt(phantom_mesh.volume)], rtol=1e-12)


def test_the_mean_strain_of_an_affine_field_is_its_own(phantom_mesh: TetMesh) -> None:
    gradient = np.random.default_rng(0).standard_normal((3, 3))
    expected = np.linalg.norm((gradient + gradient.T) / 2.0)
    found = mean_strain(phantom_mesh, phantom_mesh.vertices @ gradient)
    assert found == pytest.approx(expected, rel=1e-9)
    turn = gradient - gradient.T
    assert mean_strain(phantom_mesh, phantom_mesh.vertices @ turn) < 1e-9


@pytest.mark.parametrize("shape", [(30,), (30, 4), (30, 4, 3)])
def test_relative_errors_are_those_of_each_column(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    truth, mass = rng.standard_normal(shape), rng.uniform(0.5, 2.0, 30)
    scale = rng.uniform(-0.5, 0.5, shape[1:])
    np.testing.assert_allclose(relative_l2((1.0 + scale) * truth, truth, mass), np.abs(scale))


@pytest.mark.parametrize(("row", "column"), [(0, 0), (5, 3), (2, 1)])
def test_one_wrong_entry_of_the_gram_matrix_is_noticed(row: int, column: int) -> None:
    """The last four of six functions are new: the entry is on the diagonal, or off it twice."""
    functions = np.linalg.qr(np.random.default_rng(1).standard_normal((40, 6)))[0]
    images = functions[:, 2:]
    require_orthonormal(functions, images, "functions")
    spoilt = images.copy()
    spoilt[:, column] += 1e-3 * functions[:, row]
    with pytest.raises(ConvergenceError, match=r"functions are not .* off by 1\.0e-03"):
        require_orthonormal(functions, spoilt, "functions")
