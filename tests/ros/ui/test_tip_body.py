"""The body of a tip on the planning page."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")

from avatar_ros.ui.tip_body import tip_body, turn_to

from avatar_core.geometry.tip import Tip

pytestmark = pytest.mark.ros

TIPS = [
    Tip("sphere", 5e-3),
    Tip("flat", 3e-3),
    Tip("cone", 4e-3, 60.0),
    Tip("rounded_cone", 4e-3, 30.0, 1.5e-3),
    Tip("patch", 5e-3),
]


@pytest.mark.parametrize("tip", TIPS, ids=lambda tip: tip.shape)
def test_a_body_is_as_wide_and_as_deep_as_its_tip(tip: Tip) -> None:
    vertices, faces = tip_body(tip)
    assert vertices[:, 2].min() == pytest.approx(-tip.offset)
    assert np.hypot(*vertices.T[:2]).max() == pytest.approx(tip.radius, rel=3e-3)
    assert faces.min() == 0 and faces.max() == len(vertices) - 1


@pytest.mark.parametrize("tip", TIPS, ids=lambda tip: tip.shape)
def test_the_faces_of_a_body_look_outwards(tip: Tip) -> None:
    """Their volume is that of the tip under its shaft."""
    vertices, faces = tip_body(tip)
    volume = np.einsum("ij,ij->", vertices[faces[:, 0]], np.cross(*_others(vertices, faces))) / 6.0
    r = np.linspace(0.0, tip.radius, 2000)
    if tip.shape in ("sphere", "patch"):
        expected = 4.0 / 3.0 * np.pi * tip.radius**3
    else:
        height = tip.height(r)
        top = height[-1] + 2.0 * tip.radius
        expected = 2.0 * np.pi * np.trapezoid((top - height) * r, r)
    assert volume == pytest.approx(expected, rel=0.02)


def _others(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return vertices[faces[:, 1]], vertices[faces[:, 2]]


@pytest.mark.parametrize("direction", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, 0, -0.8), (0, 1, 0)])
def test_the_shaft_turns_to_the_normal(direction: tuple[float, float, float]) -> None:
    w, *v = turn_to(np.array(direction, float))
    z = np.array([0.0, 0.0, 1.0])
    turned = z + 2.0 * np.cross(v, np.cross(v, z) + w * z)
    np.testing.assert_allclose(turned, direction, atol=1e-12)
