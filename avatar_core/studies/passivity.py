"""What sampling, hold and delay make of the force at 1 kHz, and what passivity control takes back.

A tool of 0.3 kg in a hand that pushes with 1 N but does not hold it in place (grip zero) comes from
1 mm above a flat organ; its pose is read in steps of 0.01 mm. For each stiffness of the organ,
damping of the tool and delay:

- energy that the port gave to the tool at worst, without and with
  :mod:`avatar_core.contact.haptics.passivity`;
- border: the damping at which the swings of a tool of 1 kg, pressed in, neither grow nor fade,
  found by bisection without control, beside K (T / 2 + delay T).

Then the same over tools and grips, 0.1 to 1 kg, 0 to 1000 N/m, for several motions of the hand.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.contact.haptics.haptic_loop import (
    Device,
    Loop,
    expected_border,
    run_loop,
    stability_border,
)
from avatar_core.contact.haptics.passivity import Passivity, make_passivity
from avatar_core.contact.layout import PERIOD
from avatar_core.studies.study import Study, Value, follow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DELAYS = (0, 1, 2)  # periods
RESOLUTION = 1e-5  # [m]
START = 1e-3  # above the organ [m]
MAP_MASS, MAP_PUSH = 0.3, 1.0  # [kg], [N]
STIFFNESS = (100.0, 2500.0)  # [N/m]
DAMPING = (0.05, 20.0)  # [N s/m]
SEEN = 0.01  # [mJ] from which the map shows energy
MASSES, DAMPINGS = (0.1, 0.3, 1.0), (0.1, 0.5, 2.0, 5.0)
GRIPS, STIFFNESSES = (0.0, 100.0, 300.0, 1000.0), (200.0, 600.0, 1500.0, 2500.0)
HANDS = ("press", "in and out", "tremor", "pull out")


@dataclass(frozen=True)
class PassivitySettings:
    """Cells of the map along each axis, borders of each delay, periods of a run."""

    n_cells: int = 36
    n_borders: int = 7
    n_periods: int = 2000


FULL = PassivitySettings()
QUICK = PassivitySettings(n_cells=12, n_borders=3, n_periods=1500)


def run(_surfaces: Path | None, quick: bool, _folder: Path) -> Study:
    """The study; the organ is a flat spring, a folder of surfaces is not used."""
    return study(QUICK if quick else FULL)


def study(settings: PassivitySettings) -> Study:
    """The map, its borders, and all tools in all hands."""
    rows = [map_row(*cell, settings.n_periods) for cell in follow(_cells(settings), "map")]
    borders = [border_row(*at) for at in follow(_borders(settings), "borders")]
    grips = [hand_row(*case, settings.n_periods) for case in follow(_hands(), "hands")]
    summary = _summary(rows, borders, grips)
    return Study(
        name="passivity",
        sentence=_sentence(summary),
        summary=summary,
        rows=(*rows, *borders, *grips),
        paper={},
        draw=lambda figure: _draw(figure, rows, borders, settings),
        notices=(
            "the paper does not speak of passivity: there is no figure of its own beside ours",
        ),
    )


def _cells(settings: PassivitySettings) -> list[tuple[int, float, float]]:
    return list(
        itertools.product(
            DELAYS,
            np.geomspace(*DAMPING, settings.n_cells),
            np.geomspace(*STIFFNESS, settings.n_cells),
        )
    )


def _borders(settings: PassivitySettings) -> list[tuple[int, float]]:
    return list(itertools.product(DELAYS, np.geomspace(*STIFFNESS, settings.n_borders)))


def _hands() -> list[tuple[str, float, float, float, float, int]]:
    return list(itertools.product(HANDS, MASSES, DAMPINGS, GRIPS, STIFFNESSES, DELAYS))


def map_row(delay: int, damping: float, stiffness: float, n: int) -> dict[str, Value]:
    """One cell of the map."""
    loop = Loop(Device(MAP_MASS, damping), stiffness, delay, RESOLUTION)
    row: dict[str, Value] = {"kind": "map", "delay": delay, "damping": damping}
    row |= {"stiffness": stiffness, "mass": MAP_MASS, "grip": 0.0}
    return row | _with_and_without(loop, np.full(n, -MAP_PUSH))


def border_row(delay: int, stiffness: float) -> dict[str, Value]:
    """Damping at the border of stability, found and expected [N s/m]."""
    return {
        "kind": "border",
        "delay": delay,
        "stiffness": stiffness,
        "damping": stability_border(stiffness, delay),
        "expected": expected_border(stiffness, delay),
    }


def hand_row(
    hand: str, mass: float, damping: float, grip: float, stiffness: float, delay: int, n: int
) -> dict[str, Value]:
    """One tool in one hand."""
    loop = Loop(Device(mass, damping, grip), stiffness, delay, RESOLUTION)
    row: dict[str, Value] = {"kind": hand, "delay": delay, "damping": damping}
    row |= {"stiffness": stiffness, "mass": mass, "grip": grip}
    return row | _with_and_without(loop, hand_push(hand, grip, n))


def hand_push(hand: str, grip: float, n: int) -> FloatArray:
    """What a hand does: grip times where it wants to be, and a push of its own, (n,) [N]."""
    t: FloatArray = PERIOD * np.arange(n)
    aim: FloatArray
    push: FloatArray
    if hand == "press":
        aim, push = 1e-3 - 4e-3 * _eased(t / 0.3), -_eased(t / 0.1)
    elif hand == "in and out":
        aim, push = 4e-3 * np.cos(4.0 * np.pi * t), np.cos(4.0 * np.pi * t)
    elif hand == "tremor":
        shake = np.sin(18.0 * np.pi * t)
        aim, push = -2e-3 + 1e-3 * shake, -1.0 + 0.3 * shake
    else:
        out = _eased((t - 0.7) / 0.15)
        aim, push = 1e-3 - 6e-3 * _eased(t / 0.3) + 20e-3 * out, -2.0 * _eased(t / 0.1) + 2.5 * out
    return grip * aim + push


def _eased(s: FloatArray) -> FloatArray:
    """From 0 to 1 with the least jerk."""
    s = np.clip(s, 0.0, 1.0)
    return np.asarray(s**3 * (10.0 - 15.0 * s + 6.0 * s**2))


def controller(delay: int) -> Passivity:
    """What the study tries, for one tool."""
    return make_passivity(1, delay, RESOLUTION, stiffness=STIFFNESS[1])


def _with_and_without(loop: Loop, push: FloatArray) -> dict[str, Value]:
    """Energy given by the port [mJ] and what control changes of the force, relative."""
    free = run_loop(loop, push, START)
    limited = run_loop(loop, push, START, controller(loop.delay))
    meant = np.concatenate([np.zeros(loop.delay), limited.organ])[: len(push)]
    changed = np.linalg.norm(limited.held - meant) / max(float(np.linalg.norm(meant)), 1e-12)
    return {
        "given_without_mJ": -1e3 * min(0.0, float(free.energy.min())),
        "given_with_mJ": -1e3 * min(0.0, float(limited.energy.min())),
        "force_changed": float(changed),
    }


def _summary(
    rows: list[dict[str, Value]], borders: list[dict[str, Value]], hands: list[dict[str, Value]]
) -> dict[str, float]:
    border = expected_border(1.0, 0) * (1.0 + 2.0 * _column(hands, "delay"))
    stable = _column(hands, "damping") > 1.2 * border * _column(hands, "stiffness")
    error = np.abs(_column(borders, "damping") / _column(borders, "expected") - 1.0)
    return {
        "map_given_without_mJ": _column(rows, "given_without_mJ").max(),
        "map_given_with_mJ": _column(rows, "given_with_mJ").max(),
        "map_share_giving_without": float((_column(rows, "given_without_mJ") > SEEN).mean()),
        "map_share_giving_with": float((_column(rows, "given_with_mJ") > SEEN).mean()),
        "border_error_worst": float(error.max()),
        "hands_given_without_mJ": _column(hands, "given_without_mJ").max(),
        "hands_given_with_mJ": _column(hands, "given_with_mJ").max(),
        "force_changed_stable_median": float(np.median(_column(hands, "force_changed")[stable])),
        **{f"bound_mJ_delay_{delay}": 1e3 * controller(delay).bound for delay in DELAYS},
    }


def _column(rows: list[dict[str, Value]], key: str) -> FloatArray:
    return np.array([row[key] for row in rows], float)


def _sentence(summary: dict[str, float]) -> str:
    return (
        "Sampled, late and held, an organ's force gives a tool energy that nobody put in: over "
        f"{SEEN:g} mJ in {summary['map_share_giving_without']:.0%} of the map, ever more beyond "
        f"b = K (T/2 + delay), met within {summary['border_error_worst']:.1%}. Passivity control "
        f"leaves {summary['map_given_with_mJ']:.2f} mJ at worst."
    )


def _draw(
    figure: Figure,
    rows: list[dict[str, Value]],
    borders: list[dict[str, Value]],
    settings: PassivitySettings,
) -> None:
    from matplotlib.colors import LogNorm

    axes = figure.subplots(2, len(DELAYS), sharex=True, sharey=True)
    stiffness = np.geomspace(*STIFFNESS, settings.n_cells)
    damping = np.geomspace(*DAMPING, settings.n_cells)
    for i, key in enumerate(("given_without_mJ", "given_with_mJ")):
        for delay, axis in zip(DELAYS, axes[i], strict=True):
            given = _column([row for row in rows if row["delay"] == delay], key)
            grid = np.maximum(given.reshape(settings.n_cells, settings.n_cells), SEEN)
            shown = axis.pcolormesh(
                stiffness, damping, grid, norm=LogNorm(SEEN, 1e3), cmap="magma_r", rasterized=True
            )
            _draw_border(axis, delay, borders)
            axis.set(xscale="log", yscale="log", xlim=STIFFNESS, ylim=DAMPING)
    for delay, (upper, lower) in zip(DELAYS, axes.T, strict=True):
        late = 1e3 * PERIOD * delay
        upper.set_title(f"delay {late:g} ms: without control", fontsize=9)
        bound = 1e3 * controller(delay).bound
        lower.set_title(f"delay {late:g} ms: with it, bound {bound:.2g} mJ", fontsize=9)
    axes[0, 0].text(*_at(0.4, 0.32), "swings fade", fontsize=8, rotation=17)
    axes[0, 0].text(*_at(0.4, 0.11), "swings grow", fontsize=8, rotation=17, color="white")
    axes[1, 0].legend(fontsize=7, loc="upper left")
    for axis in axes[:, 0]:
        axis.set_ylabel("damping b [N s/m]", fontsize=9)
    for axis in axes[1]:
        axis.set_xlabel("stiffness of the organ K [N/m]", fontsize=9)
    figure.colorbar(
        shown, ax=axes, label="energy given to the tool at worst [mJ]", extend="both", pad=0.01
    )


def _at(across: float, up: float) -> tuple[float, float]:
    """A place in a panel, as fractions of its logarithmic axes."""
    (left, right), (low, high) = STIFFNESS, DAMPING
    return left * (right / left) ** across, low * (high / low) ** up


def _draw_border(axis: Axes, delay: int, borders: list[dict[str, Value]]) -> None:
    at = np.array(STIFFNESS)
    axis.plot(at, expected_border(1.0, delay) * at, "k--", lw=1.2, label="b = K (T/2 + delay)")
    mine = [row for row in borders if row["delay"] == delay]
    axis.plot(
        _column(mine, "stiffness"),
        _column(mine, "damping"),
        "o",
        ms=5,
        mfc="white",
        mec="black",
        label="swings neither grow nor fade, measured",
    )
