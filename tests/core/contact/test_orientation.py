"""Orientation of a tool, against scipy's rotations."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

from avatar_core.contact.orientation import composed, turn_tools

SHAFT = np.array([0.6, 0.0, -0.8])


def turned(*orientations: np.ndarray) -> SimpleNamespace:
    """Return the state of a tool after these orientations."""
    on = SimpleNamespace(on=True, shaft=SHAFT)
    model = SimpleNamespace(friction=on, tilt=on)
    rows = {name: np.zeros((1, n)) for name, n in (("before", 4), ("spin", 3), ("axis", 3))}
    data = SimpleNamespace(tip=np.zeros((1, 3)), **rows)
    for orientation in orientations:
        data.orientation = orientation[None]
        turn_tools(model, data)
    return data


def test_a_small_turn_is_its_rotation_vector() -> None:
    """Either of an orientation's two quaternions gives the same."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        before, vector = Rotation.random(random_state=rng), rng.normal(size=3) * 0.01
        now = (Rotation.from_rotvec(vector) * before).as_quat()
        for sign in (1.0, -1.0):
            spin = turned(before.as_quat(), sign * now).spin[0]
            np.testing.assert_allclose(spin, vector, atol=2e-6)  # |v|^3 / 24


def test_a_shaft_points_where_its_tool_does() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        rotation = Rotation.random(random_state=rng)
        axis = turned(rotation.as_quat()).axis[0]
        np.testing.assert_allclose(axis, rotation.apply(SHAFT), atol=1e-14)


def test_an_orientation_that_is_not_known_is_no_turn() -> None:
    quarter, nothing = Rotation.from_euler("x", 90.0, degrees=True).as_quat(), np.zeros(4)
    lost = turned(quarter, nothing)
    assert not lost.spin.any() and not lost.axis.any()
    assert not turned(quarter, nothing, quarter).spin.any()


def test_an_orientation_in_a_frame_is_that_of_both_together() -> None:
    rng = np.random.default_rng(2)
    frame, own = Rotation.random(random_state=rng), Rotation.random(5, random_state=rng)
    found = np.stack(composed(frame.as_quat(), own.as_quat().T), axis=1)
    np.testing.assert_allclose(found, (frame * own).as_quat(canonical=False), atol=1e-14)
