"""Accuracy against time, online and offline, with rivals in the same run.

Online: every level of detail of the displacement, timed on this machine, with errors on loads that
neither the build nor the certificate used. Offline: size of the mesh. The study also checks
certified errors, budgets on other livers, and the estimated error of each force.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from avatar_core.certify.accuracy_curve import StepErrors, step_errors
from avatar_core.fem.elasticity import Elasticity
from avatar_core.pipeline import OrganOptions, build
from avatar_core.studies.budgets import budget_rows, budget_table
from avatar_core.studies.offline_cost import mesh_rows
from avatar_core.studies.online_cost import (
    Promises,
    cost_of_effects,
    curve_rows,
    fastest_within,
    promises,
    rival_rows,
)
from avatar_core.studies.shapes import read_liver
from avatar_core.studies.study import (
    Panel,
    ProgressBar,
    Row,
    Run,
    Study,
    column,
    draw_panels,
    where,
)
from avatar_core.vademecum.model import Vademecum

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

JND = 0.07  # just noticeable difference of force (Jones, Brain 2000; Pang et al. 1991)
_NOTICED = "7 %: just noticed of a force"
PERIOD_US = 1000.0
FRESH = 1001  # seed of loads that no certificate draws


@dataclass(frozen=True)
class AccuracyTimeSettings:
    """Sizes of the study.

    They are numbers of vertices and of touches (certified, fresh and for the rivals), and sizes of
    the meshes. Budgets are tried on other livers, with their touches.
    """

    n_vertices: int = 2850
    n_certified: int = 200
    n_fresh: int = 1000
    n_rivals: int = 50
    meshes: tuple[int, ...] = (1200, 1800, 2600)
    livers: tuple[str, ...] = ("LiTS-50", "Amos-052", "Amos-086")
    n_touches: int = 300


class AccuracyTimeStudy(Study[AccuracyTimeSettings]):
    """All sweeps and the promises on LiTS-4, or the first liver of a folder."""

    name = "accuracy-time"
    full = AccuracyTimeSettings()
    quick = AccuracyTimeSettings(1200, 60, 150, 20, (1200,), ())
    paper: ClassVar = {"modes_for_10_percent": "11", "rate_hz": "1000, without a table"}

    def measure(self, run: Run[AccuracyTimeSettings]) -> None:
        settings, surface = run.settings, read_liver(run.surfaces, "LiTS-4")
        with ProgressBar(5) as bar:
            options = OrganOptions(n_vertices=settings.n_vertices, n_certified=settings.n_certified)
            v = build(surface, options, bar.begin("build"))
            assert v.certificate is not None and v.certificate.curve is not None
            elasticity = Elasticity(v.mesh, v.material, v.regions.clamped, v.element)
            curve = v.certificate.curve
            bar.begin("fresh touches")
            fresh = step_errors(v, elasticity, settings.n_fresh, FRESH)
            run.kept |= {"organ": v, "promises": promises(curve, fresh), "fresh": fresh}
            bar.begin("rivals")
            run.rows += curve_rows(curve)
            run.rows += rival_rows(v, elasticity, curve, settings.n_rivals, FRESH)
            run.rows += cost_of_effects(v)
            bar.begin("meshes")
            run.rows += mesh_rows(surface, settings.meshes)
            bar.begin("budgets")
            budgets = budget_rows(v, fresh)
            for name in settings.livers:
                other = build(read_liver(run.surfaces, name), options)
                problem = Elasticity(other.mesh, other.material, other.regions.clamped)
                budgets += budget_rows(
                    other, step_errors(other, problem, settings.n_touches, FRESH)
                )
        run.rows += budgets
        run.notices += (*short_table(run.rows), *budget_table(budgets))

    def summary(self, run: Run[AccuracyTimeSettings]) -> dict[str, float]:
        rows, v = run.rows, run.kept["organ"]
        kept: Promises = run.kept["promises"]
        error, said = run.kept["fresh"].force, _said(v, run.kept["fresh"])
        best = _best(rows)
        return {
            "promise_kept_fraction": kept.errors_kept,
            "points_kept_fraction": kept.points_kept,
            **_force_figures(error, said),
            "budget_kept_least": _least_kept(rows),
            "front_points": sum(bool(row.get("front")) for row in rows),
            "l2_95": best["error"],
            **_beside_table(rows, v),
            "force_95": float(np.quantile(error, 0.95)),
            "step_p50_us": best["p50_us"],
            "step_p99_us": best["p99_us"],
            "vertices": len(v.mesh.vertices),
        }

    def sentence(self, run: Run[AccuracyTimeSettings]) -> str:
        summary = run.summary
        return (
            f"{run.kept['organ'].name}: a step that shows all {summary['vertices']:.0f} vertices "
            f"takes {summary['step_p50_us']:.0f} us and is within {summary['l2_95']:.1%} for 95 % "
            f"of unseen touches, its force within {summary['force_95']:.1%}; promised errors held "
            f"for {summary['promise_kept_fraction']:.1%} of fresh touches, the estimated error of "
            f"a force covered {summary['force_error_coverage']:.1%} of contacts"
        )

    def draw(self, figure: Figure, run: Run[AccuracyTimeSettings]) -> None:
        draw_panels(figure, _panels(run.rows, run.kept["organ"], run.kept["fresh"]))


STUDY = AccuracyTimeStudy()


def short_table(rows: list[Row]) -> tuple[str, ...]:
    """Return the fastest steps within some errors, and rivals; all vertices shown."""
    volume = [row for row in rows if row.get("cloud") == "volume"]
    lines = ["| 95 % of loads within | step p50 / p99 [us] | by | MB |", "|---|---|---|---|"]
    for error in (0.01, 0.015, 0.02, 0.05, 0.10, 0.20, 0.40):
        found = fastest_within(volume, error)
        if found is not None:
            lines.append(_line(f"{error:.3g}", found, str(found["setting"])))
        else:
            lines.append(f"| {error:.3g} | refused: no detail of this vademecum is so exact | | |")
    for name in ("dense table", "direct solve"):
        (row,) = (row for row in volume if row["method"] == name)
        lines.append(_line(f"{row['error']:.1%}", row, name))
    return tuple(lines)


def _line(error: str, row: dict[str, Any], by: str) -> str:
    return (
        f"| {error} | {row['p50_us']:.0f} / {row['p99_us']:.0f} | {by} | {row['bytes'] / 1e6:.1f} |"
    )


def _least_kept(rows: list[Row]) -> float:
    """Return the least fraction of touches that keep a budget, over livers and budgets."""
    return min((float(row["kept"]) for row in rows if "kept" in row), default=float("nan"))  # type: ignore[arg-type]


def _best(rows: list[Row]) -> dict[str, Any]:
    """Return the row with all modes and all vertices."""
    found = [r for r in _of(rows, "vademecum") if r.get("cloud") == "volume"]
    return min(found, key=lambda r: r["error"])


def _beside_table(rows: list[Row], vademecum: Vademecum) -> dict[str, float]:
    """Return the best error in the dense table's time, all vertices shown, and the memory ratio.

    Both hold the data for display and contact, without the tip field.
    """
    volume = [row for row in rows if row.get("cloud") == "volume"]
    (table,) = _of(volume, "dense table")
    in_time = [r for r in _of(volume, "vademecum") if r["p50_us"] <= table["p50_us"]]  # type: ignore[operator]
    best: dict[str, Any] = min(in_time, key=lambda r: (r["error"], r["bytes"]))
    contact = vademecum.contact_load.nbytes + vademecum.contact_near.nbytes
    return {
        "error95_at_table_time": best["error"],
        "table_error95": float(table["error"]),  # type: ignore[arg-type]
        "memory_over_table": (best["bytes"] + contact) / float(table["bytes"]),  # type: ignore[arg-type]
    }


# --- Plots -----------------------------------------------------------------------------------


def _panels(rows: list[Row], vademecum: Vademecum, fresh: StepErrors) -> tuple[Panel, ...]:
    return (
        Panel("online, all vertices: fewer modes are faster", partial(_online, rows, "volume")),
        Panel("online, vertices of the surface alone", partial(_online, rows, "surface")),
        Panel("estimated error of a force", partial(_force, fresh.force, _said(vademecum, fresh))),
        Panel("cost of effects: one that is not named costs nothing", partial(_effects, rows)),
        Panel("size of the mesh", partial(_offline, rows)),
    )


def _online(rows: list[Row], cloud: str, axes: Axes) -> None:
    mine = [r for r in rows if r.get("cloud") == cloud]
    _scatter(axes, _of(mine, "vademecum"), "p50_us", "vademecum", s=22, c="#009E73", alpha=0.8)
    front = sorted((r for r in mine if r["front"]), key=lambda r: r["p50_us"])  # type: ignore[arg-type,return-value]
    axes.plot(column(front, "p50_us"), column(front, "error"), "k-", lw=1, label="front")
    best = [r for r in mine if r["method"] == "SVD optimum"]
    axes.plot(column(best, "p50_us"), column(best, "error"), "x--", c="#D55E00", lw=1)
    if best:
        axes.plot([], [], "x--", c="#D55E00", label="SVD optimum, one basis for all places")
    _scatter(axes, _of(mine, "dense table"), "p50_us", "dense table", marker="D", s=60, c="#E69F00")
    for row in _of(mine, "direct solve"):
        axes.axvline(row["p50_us"], color="#56B4E9", ls="-.", label="direct solve (exact)")  # type: ignore[arg-type]
    axes.set_ylim(bottom=3e-3)
    axes.plot(PERIOD_US, 0.10, "*", ms=14, c="#999999", mec="k", label="paper: 11 modes, 1 kHz")
    axes.axvline(PERIOD_US, color="#888888", ls=":")
    axes.text(PERIOD_US, axes.get_ylim()[0], " 1 ms", va="bottom", color="#555555")
    axes.axhline(JND, color="#888888", ls=":", label=_NOTICED)
    _logarithmic(axes, "time of a step, median [us]", "error that 95 % of fresh loads keep [-]")
    axes.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _said(vademecum: Vademecum, fresh: StepErrors) -> np.ndarray:
    """Return the estimated relative error of the force of each touch."""
    assert vademecum.certificate is not None
    return vademecum.certificate.force_error.relative(fresh.smoothing)


def _force_figures(error: np.ndarray, said: np.ndarray) -> dict[str, float]:
    """Return figures of the estimated errors: fraction of covered errors, and median overestimate.

    Beside them stands one error for all touches that covers as many.
    """
    covered = float(np.mean(error <= said))
    return {
        "force_error_coverage": covered,
        "force_error_overestimate": float(np.median(said / error)),
        "one_error_overestimate": float(np.median(np.quantile(error, covered) / error)),
    }


def _force(error: np.ndarray, said: np.ndarray, axes: Axes) -> None:
    axes.scatter(error, said, s=6, c="#0072B2", alpha=0.5, label="unseen contacts")
    ends = np.array([1e-4, 1.0])
    axes.plot(ends, ends, "k-", lw=1, label="said = true")
    axes.plot(ends, 3 * ends, "k:", lw=1, label="estimated = 3 x true")
    axes.axhline(JND, color="#888888", ls="-.", label=_NOTICED)
    axes.set_xlim(1e-4, 1.0)
    _logarithmic(axes, "true error of the force [-]", "estimated error of the force [-]")


def _effects(rows: list[Row], axes: Axes) -> None:
    mine = [r for r in rows if r["stage"] == "effects"]
    names = [str(r["method"]) for r in mine]
    axes.barh(names, column(mine, "p99_us"), color="#56B4E9", label="p99")
    axes.barh(names, column(mine, "p50_us"), color="#0072B2", label="median")
    axes.invert_yaxis()
    axes.set_xlabel("time of a step [us]")
    axes.legend(loc="upper right", fontsize=8)


def _offline(rows: list[Row], axes: Axes) -> None:
    mine = where(rows, stage="mesh")
    for method in dict.fromkeys(str(row["method"]) for row in mine):
        some = sorted(_of(mine, method), key=lambda row: row["size"])  # type: ignore[arg-type,return-value]
        seconds, errors = column(some, "cpu_seconds"), column(some, "error")
        axes.plot(seconds, errors, "o-", label=method)
        for k, row in enumerate(some):
            axes.annotate(
                str(row["setting"]),
                (seconds[k], errors[k]),
                xytext=(-4 if k % 2 else 4, 4),  # neighbors beside each other stay readable
                ha="right" if k % 2 else "left",
                textcoords="offset points",
                fontsize=7,
            )
        own = column(some, "vademecum_error")
        axes.plot(seconds, own, "s--", label="vademecum, on the same mesh")
    axes.margins(x=0.15)
    _logarithmic(axes, "CPU time [s]", "error [-]")


def _of(rows: list[Row], method: str) -> list[Row]:
    return where(rows, method=method)


def _scatter(axes: Axes, rows: list[Row], key: str, label: str | None, **style: Any) -> None:
    if rows:
        axes.scatter(column(rows, key), column(rows, "error"), label=label, **style)


def _logarithmic(axes: Axes, x: str, y: str) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(True, which="both", lw=0.3)
    axes.legend(fontsize=7)
