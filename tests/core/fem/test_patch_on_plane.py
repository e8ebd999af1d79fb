"""The vademecum's patch on a half-space: its own dent, and its effect on another patch."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ellipk

from avatar_core.fem.patch_on_plane import (
    FAR,
    PATCH,
    meeting,
    meeting_table,
    missed_between,
    patch_dent,
    shared_blur,
)
from avatar_core.geometry.tip import Tip
from tests.helpers.box_organ import MODULUS, PATCH_RADIUS, organ, top
from tests.helpers.contact import prepare, step


def patch_rule(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return radii [R_p] and parts of the patch's own load, 3 / pi (1 - r^2)^2."""
    node, weight = np.polynomial.legendre.leggauss(n)
    r = 0.5 * (node + 1.0)
    return r, 0.5 * weight * 6.0 * r * (1.0 - r * r) ** 2


def ring_dent(rho: float) -> float:
    """Return E* R_p / F u of the patch by Boussinesq: pressure rings as elliptic integrals."""

    def ring(s: float) -> float:
        whole = (rho + s) ** 2
        return float(3.0 * (1.0 - s * s) ** 2 * s / (rho + s) * ellipk(4.0 * rho * s / whole))

    return 4.0 / np.pi**2 * float(quad(ring, 0.0, 1.0, points=[min(rho, 1.0)], limit=200)[0])


def test_the_patch_dents_as_boussinesq_says() -> None:
    rho = np.array([0.0, 0.1, 0.5, 0.9, 1.1, 1.5, 2.0])
    table = patch_dent(rho)
    np.testing.assert_allclose(table[1:], [ring_dent(each) for each in rho[1:]], rtol=1e-6)
    assert table[0] == pytest.approx(16.0 / (5.0 * np.pi), rel=1e-12)
    assert patch_dent(np.array(30.0)) * 30.0 * np.pi == pytest.approx(1.0, rel=1e-4)


def mean_under_another(y: float) -> float:
    """Return the mean of a patch's dent under the pressure of a patch at the distance y."""
    r, load = patch_rule(60)
    angle = (np.arange(120) + 0.5) * np.pi / 120
    apart = np.sqrt(y * y + r[:, None] ** 2 + 2.0 * y * r[:, None] * np.cos(angle))
    return float(load @ patch_dent(apart).mean(axis=1))


@pytest.mark.parametrize("y", [0.0, 0.31, 1.0, 1.7, 2.9, FAR - 1e-9, FAR + 1e-9, 6.0])
def test_a_patch_lifts_another_by_the_mean_of_its_dent(y: float) -> None:
    value, slope = meeting(meeting_table(), y)
    assert value == pytest.approx(mean_under_another(y), rel=2e-3)
    if y > 0.0:
        rise = mean_under_another(y + 1e-3) - mean_under_another(y - 1e-3)
        assert slope == pytest.approx(rise / 2e-3, rel=0.02)


def test_a_patch_sinks_in_the_mean_as_the_force_law_says() -> None:
    assert meeting(meeting_table(), 0.0)[0] == pytest.approx(PATCH, rel=1e-4)


@pytest.mark.parametrize("y", [0.0, 0.4, 1.0, 1.6])
def test_what_is_blurred_at_a_point_is_blurred_as_q_says_at_a_distance(y: float) -> None:
    """Patches spread over eight places on a small circle, around one point and between two."""
    angle, table = np.arange(8) * np.pi / 4, meeting_table()
    spread = 0.08 * np.column_stack([np.cos(angle), np.sin(angle)])

    def blurred(y: float) -> float:
        apart = np.linalg.norm(spread[:, None] - spread + [y, 0.0], axis=2)
        return meeting(table, y)[0] - float(np.mean([meeting(table, r)[0] for r in apart.flat]))

    value, slope = shared_blur(table, y)
    assert value == pytest.approx(blurred(y) / blurred(0.0), abs=0.02)
    rise = shared_blur(table, y + 1e-4)[0] - shared_blur(table, max(0.0, y - 1e-4))[0]
    assert slope == pytest.approx(rise / (1e-4 if y == 0.0 else 2e-4), abs=2e-3)


def test_what_is_shared_has_no_step_where_its_table_ends() -> None:
    inside, outside = (shared_blur(meeting_table(), FAR + e) for e in (-1e-9, 1e-9))
    assert outside[0] == pytest.approx(inside[0], rel=1e-6) and inside[0] != 0.0
    assert outside[1] == pytest.approx(inside[1], abs=5e-3)


def test_a_cubes_top_is_as_soft_between_load_positions_as_at_them() -> None:
    """The 2 to 4 % that sum_ij w_i w_j C_ij lacks there are known on a half-space."""
    v = organ("cube")
    data = prepare(v, (Tip("patch", 8e-3),), cloud="off", effects=())
    rng, state, felt, blurred = np.random.default_rng(0), data.state, [], []
    for _ in range(40):
        x, z = rng.uniform(-10e-3, 10e-3, 2)
        step(data, (top("cube") + np.array([x, 5e-3, z]))[None])
        n = state.n_nodes[0]
        nodes, weight = state.nodes[:1, :n], state.weight[:1, :n, 0]
        lacking = missed_between(v.surface.centers / PATCH_RADIUS, nodes, weight)[0]
        raw = MODULUS * PATCH_RADIUS * (state.self_compliance[0] - state.blurred[0])
        felt.append(raw + lacking)
        blurred.append(raw)
        assert MODULUS * PATCH_RADIUS * state.self_compliance[0] == pytest.approx(
            felt[-1], rel=0.01
        )
    assert np.std(felt) < 0.003 * np.mean(felt)
    assert np.mean(blurred) < 0.985 * np.mean(felt)
