"""Report of a calibration: lines of text, numbers, distributions in a file and a picture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from avatar_core.uncertainty.calibration import Calibration, TouchTable
from avatar_core.uncertainty.distributions import Fixed, Lognormal
from avatar_core.uncertainty.report import UNITS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_WORST = 3  # touches that are named where the fit is bad


def say(name: str, table: TouchTable, found: Calibration) -> None:
    """Print prior and posterior, and whether the model fits."""
    force = np.exp(table.measured)
    left = f"; {table.left_out} more do not meet the organ" if table.left_out else ""
    print(
        f"{name}: {table.palpation.n_touches} touches, {len(force)} samples of {force.min():.2g} "
        f"to {force.max():.2g} N{left}"
    )
    print(f"  {'':24s}{'before, 5 to 95 %':>24s}{'most probable':>16s}{'after, 5 to 95 %':>24s}")
    for parameter, before in found.known.items():
        low, high = (float(before.ppf(np.array(p))) for p in (0.05, 0.95))
        after = found.interval(parameter)
        text = "fixed" if isinstance(before, Fixed) else f"{after[0]:.4g} to {after[1]:.4g}"
        label = f"{parameter}{' [' + unit + ']' if (unit := _unit(parameter)) else ''}"
        print(
            f"  {label:24s}{f'{low:.4g} to {high:.4g}':>24s}{found.value(parameter):16.4g}"
            f"{text:>24s}"
        )
    for line in verdict(table, found):
        print(f"  {line}")


def _unit(parameter: str) -> str:
    return "N/m3" if parameter.startswith("support.") else UNITS.get(parameter, "").strip()


def verdict(table: TouchTable, found: Calibration) -> list[str]:
    """Return whether the model fits, and where it does not."""
    told = f"forces differ by {found.rms:.1%} rms; "
    told += f"a fit so bad comes by chance in {100 * found.probability:.2g} % of cases"
    if found.explained:
        return [f"the fit is good: {told}"]
    lines = [f"NOT EXPLAINED: {told}"]
    for touch in np.argsort(-np.abs(found.deviations))[:_WORST]:
        at = table.palpation.tip[table.palpation.touch == touch][-1]
        place = "({:.0f}, {:.0f}, {:.0f}) mm".format(*(1e3 * at))
        off = float(np.expm1(found.misfit[table.touch == touch].mean()))
        lines.append(f"  at {place} the measured force is {off:+.0%} off")
    lines.append(
        "the organ has something that the model lacks, a place is wrong, or the stated errors are "
        "too small; do not use these values"
    )
    return lines


def numbers(table: TouchTable, found: Calibration) -> dict[str, Any]:
    """Return all figures, in SI units."""
    sampled = table.palpation.sampled
    return {
        "explained": found.explained,
        "probability": found.probability,
        "values": {
            name: {
                "value": found.value(name),
                "low": found.interval(name)[0],
                "high": found.interval(name)[1],
            }
            for name in found.known
        },
        "parameters": list(found.names),
        "correlation": _correlation(found).tolist(),
        "left_out_touches": table.left_out,
        "samples": [
            {"touch": int(touch), "tip_m": tip.tolist(), "measured_N": float(force), "misfit": off}
            for touch, tip, force, off in zip(
                table.touch,
                table.palpation.tip[sampled],
                np.exp(table.measured),
                found.misfit.tolist(),
                strict=True,
            )
        ],
    }


def _correlation(found: Calibration) -> np.ndarray:
    deviation = np.sqrt(np.diag(found.covariance))
    return found.covariance / np.outer(deviation, deviation)


def distributions_text(name: str, found: Calibration) -> str:
    """Return the posterior as YAML, for `avatar uncertainty FILE --given` and the contact node."""
    told: dict[str, Any] = {}
    for parameter in found.known:
        one = found.posterior(parameter)
        if isinstance(one, Lognormal):
            told[parameter] = {"lognormal": {"median": one.median, "factor": one.factor}}
        else:
            told[parameter] = {"fixed": found.value(parameter)}
    return f"# {name}, calibrated by palpation\n" + yaml.safe_dump(told, sort_keys=False)


def picture(file: Path, name: str, table: TouchTable, found: Calibration) -> None:
    """Draw measured over computed forces, and each parameter before and after."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(12.0, 4.8), layout="constrained")
    _draw_forces(axes[0], table, found)
    _draw_parameters(axes[1], found)
    figure.suptitle(f"{name}: {verdict(table, found)[0]}", fontsize=10)
    figure.savefig(file, dpi=120)
    plt.close(figure)


def _draw_forces(axes: Axes, table: TouchTable, found: Calibration) -> None:
    measured = np.exp(table.measured)
    computed = np.exp(table.measured - found.misfit)
    points = axes.scatter(computed, measured, c=table.touch, cmap="viridis", s=18)
    ends = np.array([min(measured.min(), computed.min()), max(measured.max(), computed.max())])
    axes.plot(ends, ends, color="grey", linewidth=1.0, label="measured = computed")
    axes.set(xscale="log", yscale="log", xlabel="computed force [N]", ylabel="measured force [N]")
    axes.figure.colorbar(points, ax=axes, label="number of the touch")
    axes.legend(frameon=False)
    axes.grid(alpha=0.3)


def _draw_parameters(axes: Axes, found: Calibration) -> None:
    """Draw each parameter over its most probable value, on a scale of factors."""
    for k, name in enumerate(found.names):
        middle = found.value(name)
        before = [float(found.known[name].ppf(np.array(p))) / middle for p in (0.05, 0.95)]
        after = [value / middle for value in found.interval(name)]
        axes.plot(before, [k, k], color="0.75", linewidth=8.0, label="before" if k == 0 else None)
        axes.plot(after, [k, k], color="tab:blue", linewidth=3.0, label="after" if k == 0 else None)
        axes.plot([1.0], [k], "o", color="tab:blue")
    labels = [f"{name}\n{found.value(name):.4g}" for name in found.names]
    axes.set_yticks(range(len(labels)), labels)
    axes.set(xscale="log", xlabel="over the most probable value; bars hold 90 %")
    axes.set_ylim(-0.5, len(labels) - 0.5)
    axes.legend(frameon=False)
    axes.grid(axis="x", alpha=0.3)
