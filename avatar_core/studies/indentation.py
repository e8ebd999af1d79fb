"""A rigid sphere in a neo-Hookean half-space: the curve that the step adds to small strain.

The curve is F / (E R^2) over depth / R for several Poisson's ratios, by axisymmetric finite
elements (:mod:`avatar_core.fem.sphere_indentation`). Beside it stand Sneddon's exact sphere at
small strain and Hertz's paraboloid. At small strain the elements are compared with Sneddon, at
large strain with elements of half the size. The coefficients that
:mod:`avatar_core.tips.large_strain` stores are fitted anew. They are the rows of kind
"coefficients" of the record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import brentq

from avatar_core.fem.elasticity import Material
from avatar_core.fem.sphere_indentation import Domain, Indentation, SphereIndentation
from avatar_core.geometry.tip import Tip
from avatar_core.studies.contact import sneddon
from avatar_core.studies.study import Row, Run, Study, column, follow, where
from avatar_core.tips.large_strain import COEFFICIENTS, interpolated

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TIP = Tip("sphere", 1e-2)  # any radius: results are made dimensionless
_DEPTHS = (*np.arange(2, 10) / 20.0, *np.arange(5, 16) / 10.0)  # [R]
_COMPARED = (0.25, 0.5, 1.0, 1.5)  # depths at which elements are halved [R]
_SHOWN = (0.3, 0.45, 0.49)  # nu


@dataclass(frozen=True)
class IndentationSettings:
    """Poisson's ratios, those with halved elements, depths [R], elements [R]."""

    ratios: tuple[float, ...] = (0.0, 0.2, 0.3, 0.4, 0.45, 0.48, 0.49)
    halved: tuple[float, ...] = _SHOWN
    depths: tuple[float, ...] = _DEPTHS
    element: float = 0.1


class IndentationStudy(Study[IndentationSettings]):
    """All curves, the fit and its errors; a folder of surfaces is not used."""

    name = "indentation"
    full = IndentationSettings()
    quick = IndentationSettings(ratios=_SHOWN, halved=(0.45,), depths=_COMPARED, element=0.2)

    def measure(self, run: Run[IndentationSettings]) -> None:
        """Measure, and keep the coefficients fitted anew as a table."""
        settings = run.settings
        domain, half = Domain(settings.element), Domain(0.5 * settings.element)
        for nu in follow(settings.ratios, "neo-Hookean"):
            pressed = SphereIndentation(nu, domain=domain).press(settings.depths)
            run.rows += _rows("curve", nu, pressed)
        for nu in follow(settings.halved, "half the elements"):
            run.rows += _rows("halved", nu, SphereIndentation(nu, domain=half).press(_COMPARED))
        nearest = max(settings.ratios)  # to incompressible: where elements would lock
        small = SphereIndentation(nearest, False, domain)
        run.rows += _rows("small strain", nearest, small.press(_COMPARED[:3]))
        fitted = run.kept["fitted"] = fit(run.rows)
        names = ("nu", "c_0", "c_1", "c_2", "c_3", "largest")
        for row in fitted.tolist():
            run.add({"kind": "coefficients", **dict(zip(names, row, strict=True))})
        run.notices.append(
            "the paper has linear contact only: there is no figure of its own beside ours"
        )

    def summary(self, run: Run[IndentationSettings]) -> dict[str, float]:
        curve = where(run.rows, kind="curve")
        ratio = {(row["nu"], row["depth"]): float(str(row["ratio"])) for row in curve}
        halving = [
            abs(float(str(row["ratio"])) - ratio[row["nu"], row["depth"]])
            for row in where(run.rows, kind="halved")
            if (row["nu"], row["depth"]) in ratio
        ]
        small = column(where(run.rows, kind="small strain"), "ratio")
        return {
            **{
                f"ratio_nu_{nu:g}_depth_{depth:g}": ratio[nu, depth]
                for nu in _SHOWN
                for depth in _COMPARED
                if (nu, depth) in ratio
            },
            "small_strain_vs_sneddon": float(np.abs(small - 1.0).max()),
            "halving_worst": max(halving, default=float("nan")),
            "stored_law_worst": _misses(curve, COEFFICIENTS),
            "new_fit_worst": _misses(curve, run.kept["fitted"]),
        }

    def sentence(self, run: Run[IndentationSettings]) -> str:
        summary = run.summary
        return (
            "A sphere pressed into neo-Hookean tissue of nu 0.49 has "
            f"{summary['ratio_nu_0.49_depth_0.5']:.3f} of the small-strain force at half its "
            f"radius, {summary['ratio_nu_0.49_depth_1']:.3f} at its radius, "
            f"{summary['ratio_nu_0.49_depth_1.5']:.3f} at 1.5. The law misses the elements by "
            f"{summary['stored_law_worst']:.1%} at most, halved elements change "
            f"{summary['halving_worst']:.1%}; at small strain they miss Sneddon by "
            f"{summary['small_strain_vs_sneddon']:.1%}."
        )

    def draw(self, figure: Figure, run: Run[IndentationSettings]) -> None:
        left, right = figure.subplots(1, 2)
        curve = where(run.rows, kind="curve")
        for k, nu in enumerate(sorted(set(column(curve, "nu")))):
            _draw_curve(left, right, where(curve, nu=nu), nu, f"C{k}")
        left.plot([], [], "k--", lw=0.8, label="Sneddon, small strain")
        left.plot([], [], "k:", lw=0.8, label="Hertz")
        left.set(xlabel="depth / R", ylabel="F / (E R²)", title="force; dots: finite elements")
        right.set(
            xlabel="depth / R",
            ylabel="F / F of Sneddon",
            title="over small strain, by nu; lines: law",
        )
        right.axhline(1.0, color="k", ls="--", lw=0.8)
        left.legend(fontsize=8)


STUDY = IndentationStudy()


def small_strain_depth(load: float) -> float:
    """Return a sphere's depth in a half-space [R] under the load F / (E* R^2), by Sneddon."""
    if load == 0.0:
        return 0.0

    def missing(rapidity: float) -> float:
        a = np.tanh(rapidity)
        return float((a * a + 1.0) * rapidity - a - load)

    rapidity = brentq(missing, 1e-6, 50.0, xtol=1e-14)
    return float(rapidity * np.tanh(rapidity))


def law_depth(load: float, law: np.ndarray) -> float:
    """Return the depth at large strain, by c_0 ... c_3 of the law; within the range of its fit."""
    s = np.cbrt(0.75 * load)
    return small_strain_depth(load) + float(s**3 * (law[:4] @ s ** np.arange(4)))


def law_force(depth: float, nu: float, table: np.ndarray = COEFFICIENTS) -> float:
    """Return F / (E R^2) at a depth [R] by the law."""
    law = interpolated(table, nu)
    load = brentq(lambda load: law_depth(load, law) - depth, 1e-9, 1.4 * law[4])
    return float(load / (1.0 - nu**2))


def fit(rows: Sequence[Row]) -> np.ndarray:
    """Return a table like ``COEFFICIENTS``, by least squares of the relative depth at each nu."""
    curve = where(rows, kind="curve")
    found = []
    for ratio in sorted(set(column(curve, "nu").tolist())):
        own = where(curve, nu=ratio)
        depth, load = column(own, "depth"), column(own, "force") * (1.0 - ratio**2)
        added = depth - np.array([small_strain_depth(each) for each in load])
        s = np.cbrt(0.75 * load)
        powers = s[:, None] ** np.arange(3, 7)
        law = np.linalg.lstsq(powers / depth[:, None], added / depth, rcond=None)[0]
        found.append([ratio, *law, float(s.max() ** 3)])
    return np.array(found)


def _rows(kind: str, nu: float, found: Sequence[Indentation]) -> list[Row]:
    return [
        {
            "kind": kind,
            "nu": nu,
            "depth": float(each.depth),
            "force": each.force,
            "sneddon": _sneddon(nu, each.depth),
            "hertz": 4.0 / 3.0 * each.depth**1.5 / (1.0 - nu**2),
            "ratio": each.force / _sneddon(nu, each.depth),
            "contact_radius": each.contact,
            "min_det": each.min_det,
        }
        for each in found
    ]


def _sneddon(nu: float, depth: float) -> float:
    """Return F / (E R^2) at small strain."""
    radius = _TIP.radius
    return sneddon(_TIP, Material(1.0, nu), depth * radius) / radius**2


def _misses(curve: list[Row], table: np.ndarray) -> float:
    """Return the worst error of the law's force, relative."""
    nu, depth, force = (column(curve, key) for key in ("nu", "depth", "force"))
    found = [law_force(d, ratio, table) for d, ratio in zip(depth, nu, strict=True)]
    return float(np.abs(np.array(found) / force - 1.0).max())


def _draw_curve(left: Axes, right: Axes, own: list[Row], nu: float, colour: str) -> None:
    depth, force, small = (column(own, key) for key in ("depth", "force", "sneddon"))
    law = np.array([law_force(each, nu) for each in depth])
    if nu in _SHOWN:
        left.plot(depth, force, "o", ms=3, color=colour, label=f"neo-Hookean, nu {nu:g}")
        left.plot(depth, law, "-", color=colour)
        left.plot(depth, small, "--", lw=0.8, color=colour)
        left.plot(depth, column(own, "hertz"), ":", lw=0.8, color=colour)
    right.plot(depth, force / small, "o", ms=3, color=colour)
    right.plot(depth, law / small, "-", color=colour)
    end = (depth[-1], force[-1] / small[-1])
    right.annotate(f" {nu:g}", end, color=colour, fontsize=7, va="center")
