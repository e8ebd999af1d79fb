"""Steps that ``avatar bench effects`` times: each has a force on the tip."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.contact.effects import Tilt
from avatar_core.contact.effects.base import find
from avatar_core.studies.bench.effects import LEAN, PUNCH, cases_on
from avatar_core.studies.bench.methods import tool_paths
from tests.helpers.box_organ import UP, organ
from tests.helpers.contact import prepare, step


@pytest.mark.long
def test_a_leaning_punch_is_felt_all_along_its_path() -> None:
    """A flat face that starts too deep counts as set there, without a force."""
    cube = organ("cube")
    (effects,) = [effects for _, _, effects in cases_on(cube) if find(effects, Tilt)]
    data = prepare(cube, (PUNCH,), effects=effects)
    data.reset()
    assert float(data.model.arrays.tilt.shaft @ UP) == pytest.approx(np.cos(LEAN), abs=0.01)
    felt = []
    for tips in tool_paths(cube, 1, 100, PUNCH):
        step(data, tips, np.array([[0.0, 0.0, 0.0, 1.0]]))
        felt.append((np.linalg.norm(data.out.force[0]), np.linalg.norm(data.out.torque[0])))
    assert np.min(felt, axis=0)[0] > 1.0  # N
    assert np.min(felt, axis=0)[1] > 1e-3  # Nm, righting torque
