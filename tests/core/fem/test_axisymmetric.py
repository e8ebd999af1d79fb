"""A sphere on a half-space by finite elements, against closed forms, and the fitted law."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import brentq

from avatar_core.fem.axisymmetric import AxisymmetricBody
from avatar_core.fem.elasticity import Material
from avatar_core.fem.hyperelastic_materials import NeoHookean
from avatar_core.fem.sphere_indentation import Domain, SphereIndentation
from avatar_core.geometry.tip import Tip
from avatar_core.studies import indentation
from avatar_core.studies.indentation import law_force
from avatar_core.tips.large_strain import (
    COEFFICIENTS,
    NONE,
    evaluate_large_dent,
    interpolated,
    large_dent_of,
    with_least,
)

COARSE, COARSER, SMALL = Domain(0.2), Domain(0.4), Domain(0.25, 30.0)


def sneddon(depth: float, nu: float) -> float:
    """Return F / (E R^2) of a sphere at small strain (Sneddon 1965)."""
    a = brentq(lambda a: a * np.arctanh(a) - depth, 0.0, 1.0 - 1e-14)
    return float((0.5 * (a * a + 1.0) * np.log((1.0 + a) / (1.0 - a)) - a) / (1.0 - nu**2))


@pytest.mark.long
def test_at_small_strain_the_sphere_is_sneddons() -> None:
    found = SphereIndentation(0.45, False, COARSE).press([0.5, 1.0])
    for each in found:
        assert each.force == pytest.approx(sneddon(each.depth, 0.45), rel=0.01)


def test_a_stretched_cylinder_is_in_equilibrium() -> None:
    """Uniaxial compression of a neo-Hookean cylinder with a free wall."""
    nu, along, size = 0.45, 0.7, 3.0
    lam, mu = Material(1.0, nu).lame

    def wall(across: float) -> float:
        log_j = np.log(across**2 * along)
        return float(mu * (across - 1.0 / across) + lam * log_j / across)

    across = brentq(wall, 0.9, 2.0)
    pressed = mu * (along - 1.0 / along) + lam * np.log(across**2 * along) / along
    body = AxisymmetricBody(np.linspace(0.0, size, 7), NeoHookean(Material(1.0, nu)))
    r, z = body.places.T
    u = np.stack([(across - 1.0) * r, (along - 1.0) * z], axis=1)
    residual = body.forces(u).reshape(-1, 2)
    inside = (z > -size + 1e-9) & (z < -1e-9)
    np.testing.assert_allclose(residual[inside], 0.0, atol=1e-12)
    top = residual[z > -1e-9, 1].sum()
    assert top == pytest.approx(np.pi * size**2 * pressed, rel=1e-12)


def test_the_force_is_the_derivative_of_the_energy_of_the_elements() -> None:
    low, middle, high = SphereIndentation(0.48, domain=SMALL).press([0.298, 0.3, 0.302])
    assert (high.energy - low.energy) / 0.004 == pytest.approx(middle.force, rel=1e-3)


def against_elements(nu: float, depths: list[float], domain: Domain, tolerance: float) -> None:
    for each in SphereIndentation(nu, domain=domain).press(depths):
        assert law_force(each.depth, nu) == pytest.approx(each.force, rel=tolerance)


@pytest.mark.long
def test_the_law_is_that_of_the_elements() -> None:
    """At a ratio between those of the table."""
    against_elements(0.47, [0.5], COARSER, 0.01)


@pytest.mark.long
def test_the_law_is_that_of_the_elements_between_its_rows() -> None:
    against_elements(0.43, [0.2, 0.5, 1.0, 1.5], Domain(0.1), 0.006)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.44, 0.49])
def test_the_added_depth_has_its_slope_and_its_energy(nu: float) -> None:
    """d eta / dL and dPsi / dL = L d eta / dL, also along the tangent."""
    law = dent_of(Tip("sphere", 3e-3), nu)
    for part in (1e-3, 0.1, 1.0, 2.0, 3.0):
        load, step = part * 9e-6, 1e-3 * part * 9e-6
        low, high = (evaluate_large_dent(law, 0, load + sign * step) for sign in (-1.0, 1.0))
        _, slope, _ = evaluate_large_dent(law, 0, load)
        assert (high[0] - low[0]) / (2.0 * step) == pytest.approx(slope, rel=1e-4)
        assert (high[2] - low[2]) / (2.0 * step) == pytest.approx(load * slope, rel=1e-4)


@pytest.mark.parametrize("nu", np.linspace(0.0, 0.49, 12))
def test_the_depth_grows_with_the_force(nu: float) -> None:
    """The dent's compliance never falls below the part of 1 / (2 E* R) that the law states."""
    tip = Tip("sphere", 5e-3)
    law, least = dent_of(tip, nu), large_dent_of(tip, nu, True)[5]
    assert 0.3 < least <= 1.0
    for load in np.geomspace(1e-4, 10.0, 60) * tip.radius**2:
        slope = evaluate_large_dent(law, 0, load)[1]
        assert 0.5 / tip.radius + slope >= 0.5 * least / tip.radius * (1.0 - 1e-3)


@pytest.mark.parametrize(
    ("tip", "neo_hookean"),
    [(Tip("sphere", 5e-3), False), (Tip("flat", 5e-3), True), (Tip("cone", 5e-3, 60.0), True)],
)
def test_other_dents_are_those_of_small_strain(tip: Tip, neo_hookean: bool) -> None:
    np.testing.assert_array_equal(large_dent_of(tip, 0.48, neo_hookean), NONE)


def test_a_table_is_kept_at_its_rows() -> None:
    for row in COEFFICIENTS:
        np.testing.assert_allclose(interpolated(COEFFICIENTS, row[0]), row[1:], atol=1e-12)
        np.testing.assert_array_equal(with_least(row[1:])[:5], row[1:])


def test_a_fit_finds_the_law_of_its_data(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [
        {"kind": "curve", "nu": nu, "depth": d, "force": law_force(d, nu)}
        for nu in COEFFICIENTS[:, 0]
        for d in (*np.arange(0.1, 1.5, 0.1), 1.5)
    ]
    np.testing.assert_allclose(indentation.fit(rows)[:, :5], COEFFICIENTS[:, :5], atol=1e-6)


def dent_of(tip: Tip, nu: float) -> SimpleNamespace:
    """Return the part of a tip's law that :func:`evaluate_large_dent` reads."""
    law = SimpleNamespace(
        large_dent=large_dent_of(tip, nu, True)[None], radius=np.array([tip.radius])
    )
    return SimpleNamespace(law=law)
