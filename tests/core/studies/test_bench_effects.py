"""What ``avatar bench effects`` times: steps in which a tip is felt."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.contact.effects import Tilt
from avatar_core.contact.effects.selection import find
from avatar_core.contact.model import prepare, step
from avatar_core.studies.bench.effects import LEAN, PUNCH, cases_on
from avatar_core.studies.bench.methods import tool_paths
from tests.helpers.box_organ import UP, organ


@pytest.mark.long
def test_a_leaning_punch_is_felt_all_along_its_path() -> None:
    """A flat face that is found too deep counts as set there, and is not felt."""
    cube = organ("cube")
    (effects,) = [effects for _, _, effects in cases_on(cube) if find(effects, Tilt)]
    model = prepare(cube, (PUNCH,), effects=effects)
    model.reset()
    assert model.axes is not None and model.shaft is not None
    model.axes[:] = model.shaft
    assert float(model.shaft @ UP) == pytest.approx(np.cos(LEAN), abs=0.01)
    felt = []
    for tips in tool_paths(cube, 1, 100, PUNCH):
        step(model, tips)
        felt.append((np.linalg.norm(model.out.force[0]), np.linalg.norm(model.out.torque[0])))
    assert np.min(felt, axis=0)[0] > 1.0  # N
    assert np.min(felt, axis=0)[1] > 1e-3  # Nm, that rights it
