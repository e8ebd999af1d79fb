"""Rival methods of the step: same forces and displacements, or their speed is meaningless."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.contact.model import model_of, step
from avatar_core.studies.bench import methods
from avatar_core.studies.bench.methods import SPHERE, Kind, tool_paths
from avatar_core.vademecum.model import Vademecum

APART = 5e-3  # difference by smoothing and blocks, which the tables do not have


@pytest.mark.parametrize("kind", [np.float32, np.int16])
def test_a_dense_table_feels_and_shows_what_the_step_does(straight: Vademecum, kind: Kind) -> None:
    ours = model_of(straight, (SPHERE,), cloud="volume").data()
    table, call = methods._dense(straight, 1, kind)
    for tip in tool_paths(straight, 1)[:60:6]:
        step(ours.model, ours, tip)
        call(tip)
    assert ours.out.n_contacts[0] == table.out.n_contacts[0] == 1
    np.testing.assert_allclose(table.out.force, ours.out.force, rtol=APART)
    moved, other = (data.out.cloud[:, 3:] for data in (ours, table))
    assert np.linalg.norm(other - moved) < APART * np.linalg.norm(moved)


def test_a_table_in_16_bits_is_right_to_a_part_of_its_peak() -> None:
    exact = np.random.default_rng(0).standard_normal((5, 3, 40)).astype(np.float32)
    exact[0] *= 1e-6
    exact[1, 2] = 0.0
    found, factor = methods._stored(exact, np.int16)
    assert found.dtype == np.int16
    peak = np.abs(exact).max(axis=2, keepdims=True)
    assert (np.abs(found * factor[..., None] - exact) <= peak / 60000.0).all()
