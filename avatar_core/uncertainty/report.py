"""Bands as lines of text, as numbers and as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.uncertainty.bands import Bands
from avatar_core.uncertainty.distributions import Distribution, Fixed

if TYPE_CHECKING:
    from matplotlib.axes import Axes

UNITS = {"young": " Pa"}


def rows(depths: Sequence[float], bands: Bands) -> list[dict[str, float | list[float]]]:
    """Return one row for each place and depth, in SI units."""
    found: list[dict[str, float | list[float]]] = []
    for i, center in enumerate(bands.places):
        for k, depth in enumerate(depths):
            row: dict[str, float | list[float]] = {"place_m": center.tolist(), "depth_m": depth}
            for name, values in (("force_N", bands.force), ("target_moved_m", bands.moved)):
                for level, value in zip(("5", "50", "95"), values[:, i, k], strict=True):
                    row[f"{name}_{level}"] = float(value)
            row |= {f"share_{name}": float(s[i, k]) for name, s in bands.shares.items()}
            found.append(row)
    return found


def say(
    name: str, draws: int, known: Mapping[str, Distribution], depths: Sequence[float], bands: Bands
) -> None:
    """Print the assumptions, and a line for each place and depth."""
    print(f"{name}: {draws} draws")
    for parameter, one in known.items():
        print(f"  {parameter:10s} {one.said(UNITS.get(parameter, ''))}")
    shares = "".join(f"{parameter:>10s}" for parameter in bands.shares)
    print(f"  {'':22s}{'':>8s}{'force [N]':>26s}{'target moves [mm]':>27s}  share of the force's")
    ends = f"{'5 %':>8s}{'50 %':>9s}{'95 %':>9s}"
    print(f"  {'place [mm]':22s}{'depth':>8s}{ends} {ends}  {shares}")
    for i, center in enumerate(bands.places):
        place = "({:.0f}, {:.0f}, {:.0f})".format(*(1e3 * center))
        for k, depth in enumerate(depths):
            force = "".join(f"{value:9.3g}" for value in bands.force[:, i, k])
            moved = "".join(f"{1e3 * value:9.3g}" for value in bands.moved[:, i, k])
            parts = "".join(f"{share[i, k]:10.0%}" for share in bands.shares.values())
            print(f"  {place:22s}{1e3 * depth:5.1f} mm{force[1:]} {moved[1:]}  {parts}")
            place = ""
    print("  the bands hold 90 % of the draws; the error of the vademecum comes on top ('show')")


def picture(
    file: Path, name: str, known: Mapping[str, Distribution], depths: Sequence[float], bands: Bands
) -> None:
    """Draw the bands over depth, and the variance fractions at the largest depth."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(14.0, 4.6), layout="constrained")
    labels = ["({:.0f}, {:.0f}, {:.0f})".format(*(1e3 * center)) for center in bands.places]
    _draw_bands(axes[0], depths, bands.force, labels, "force [N]")
    _draw_bands(axes[1], depths, 1e3 * bands.moved, labels, "displacement of the target [mm]")
    _draw_shares(axes[2], bands, labels)
    free = ", ".join(
        f"{parameter} {one.said(UNITS.get(parameter, ''))}"
        for parameter, one in known.items()
        if not isinstance(one, Fixed)
    )
    figure.suptitle(f"{name}: medians, and bands of 90 %, for {free or 'fixed values'}")
    figure.savefig(file, dpi=120)
    plt.close(figure)


def _draw_bands(
    axes: Axes, depths: Sequence[float], values: FloatArray, labels: Sequence[str], what: str
) -> None:
    millimetres = 1e3 * np.asarray(depths)
    for i, label in enumerate(labels):
        low, median, high = values[:, i]
        (line,) = axes.plot(millimetres, median, label=label)
        axes.fill_between(millimetres, low, high, alpha=0.2, color=line.get_color(), linewidth=0)
    axes.set(xlabel="depth of the tip [mm]", ylabel=what, ylim=(0.0, None))
    axes.legend(title="place [mm]", frameon=False)
    axes.grid(alpha=0.3)


def _draw_shares(axes: Axes, bands: Bands, labels: Sequence[str]) -> None:
    place, left = np.arange(len(labels)), np.zeros(len(labels))
    for parameter, share in bands.shares.items():
        axes.barh(place, 100.0 * share[:, -1], left=100.0 * left, label=parameter)
        left += share[:, -1]
    axes.set(xlabel="first-order share of the force's variance [%]", xlim=(0.0, 100.0))
    axes.set_yticks(place, labels)
    axes.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
