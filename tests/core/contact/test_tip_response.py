"""The position where a tip presses, and the compliance there."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.common.splines import evaluate_all
from avatar_core.contact.organ_response import _taking, tip_carriers
from avatar_core.fem.patch_loads import load_surface
from avatar_core.vademecum.tip_field import make_tip_field
from tests.core.vademecum.test_tip_field import PATCH, RADIUS, coarse_ball
from tests.helpers.known_surfaces import ball

N, SPACING = 24, 2.5e-3


def test_a_tip_presses_at_the_point_under_it_however_large_it_is() -> None:
    """Up to 14 mm above a ball of 80 faces, it lies on the line to the centre of the round ball.

    The face closest to the tip's centre itself lies up to 3 mm beside.
    """
    mesh, regions = coarse_ball()
    loads = load_surface(mesh, regions, PATCH)
    field = make_tip_field(mesh, regions, PATCH, ball(RADIUS, level=5))
    carriers = tip_carriers(loads, field, 0.0, 14e-3)
    points = field.origin + field.spacing[0] * np.argwhere(carriers.shell)
    place = np.einsum("qi,qid->qd", carriers.weight, loads.centers[carriers.carrier])
    height = np.linalg.norm(points, axis=1)
    far = (height > RADIUS + 8e-3) & (height < RADIUS + 14e-3) & (points[:, 1] > 0.5 * height)
    radius = points[far] / height[far, None]
    aside = place[far] - np.einsum("qd,qd->q", place[far], radius)[:, None] * radius
    assert far.sum() > 500
    assert np.linalg.norm(aside, axis=1).max() < 1.3e-3


def at_its_samples(coefficients: np.ndarray) -> np.ndarray:
    inner = np.argwhere(np.ones((N - 4,) * 3, bool)) + 2
    out = np.empty(len(inner))
    at = SPACING * inner.astype(float)
    evaluate_all(coefficients, np.zeros(3), SPACING, at, out, np.empty_like(at))
    return out.reshape((N - 4,) * 3)


def test_the_splines_take_the_compliance_of_each_sample() -> None:
    x = np.arange(N) * 0.4
    values = 2.0 + np.sin(x)[:, None, None] * np.cos(0.7 * x)[None, :, None] * np.ones(N)
    inner = values[2:-2, 2:-2, 2:-2]
    np.testing.assert_allclose(at_its_samples(_taking(values)), inner, rtol=0.01)
    assert abs(at_its_samples(values.astype(np.float32)) - inner).max() > 0.025  # blurred


@pytest.mark.parametrize("jump", [10.0, 1e3])
def test_a_compliance_stays_positive_where_it_jumps(jump: float) -> None:
    values = np.ones((N, N, N))
    values[N // 2 :] = jump
    found = _taking(values)
    assert found.min() > 0.5 and found.max() < 1.5 * jump
