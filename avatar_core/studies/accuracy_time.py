"""Accuracy against time, online and offline, with rivals in the same run.

Online: every level of detail of the displacement, timed on this machine, with errors on loads that
neither the build nor the certificate used. Offline: mesh size, grid of a level set, interpolation
of shapes, and fidelity of a patient. Also whether certified errors, and the estimated error of each
force, hold.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from avatar_core.certify.linear import measured
from avatar_core.fem.elasticity import Elasticity
from avatar_core.pipeline import OrganOptions, build
from avatar_core.studies.force_error import ForceErrors, force_errors
from avatar_core.studies.offline_cost import (
    grid_rows,
    load_rows,
    mesh_rows,
    patient_rows,
    shape_rows,
)
from avatar_core.studies.online_cost import (
    Promises,
    budget_rows,
    cost_of_effects,
    curve_rows,
    fastest_within,
    promises,
    rival_rows,
)
from avatar_core.studies.report import Panel, write_report
from avatar_core.studies.shapes import read_liver
from avatar_core.studies.study import ProgressBar, Row, Run, Study, column, where
from avatar_core.vademecum.model import Vademecum

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

JND = 0.07  # of force, that a hand just notices (Jones, Brain 2000; Pang et al. 1991)
_NOTICED = "7 %: just noticed of a force"
PERIOD_US = 1000.0
FRESH = 1001  # seed of loads that no certificate draws


@dataclass(frozen=True)
class AccuracyTimeSettings:
    """Numbers of vertices, certified and fresh loads, and contacts; sizes of the offline sweeps."""

    n_vertices: int = 2850
    n_certified: int = 200
    n_fresh: int = 100
    n_contacts: int = 1000
    meshes: tuple[int, ...] = (1200, 1800, 2600)
    spacings: tuple[float, ...] = (20e-3, 10e-3, 5e-3, 2.5e-3)
    projections: tuple[float, ...] = (0.02, 5e-3, 1.5e-3)
    n_livers: int = 32
    n_base: int = 6
    n_patient: int = 600


class AccuracyTimeStudy(Study[AccuracyTimeSettings]):
    """All sweeps and the promises on LiTS-4, or the first liver of a folder, and a page."""

    name = "accuracy-time"
    full = AccuracyTimeSettings()
    quick = AccuracyTimeSettings(1200, 60, 40, 150, (1200,), (20e-3, 10e-3), (5e-3,), 16, 3, 350)
    paper: ClassVar = {"modes_for_10_percent": "11", "rate_hz": "1000, without a table"}

    def measure(self, run: Run[AccuracyTimeSettings]) -> None:
        settings, surface = run.settings, read_liver(run.surfaces, "LiTS-4")
        with ProgressBar(5) as bar:
            options = OrganOptions(n_vertices=settings.n_vertices, n_certified=settings.n_certified)
            v = build(surface, options, bar.begin("build"))
            assert v.certificate is not None and v.certificate.curve is not None
            elasticity = Elasticity(v.mesh, v.material, v.regions.clamped, v.element)
            curve = v.certificate.curve
            bar.begin("fresh loads")
            fresh = measured(v, elasticity, settings.n_fresh, FRESH)
            run.kept |= {"organ": v, "promises": promises(curve, fresh)}
            run.kept["contacts"] = force_errors(v, elasticity, settings.n_contacts, FRESH)
            bar.begin("rivals")
            run.rows += curve_rows(curve) + budget_rows(curve)
            run.rows += rival_rows(v, elasticity, curve, settings.n_fresh // 2, FRESH)
            run.rows += cost_of_effects(v)
            bar.begin("mesh, loads and grid")
            run.rows += mesh_rows(surface, settings.meshes)
            run.rows += load_rows(elasticity, v.surface, settings.projections)
            run.rows += grid_rows(surface, settings.spacings)
            bar.begin("shapes and patients")
            run.rows += shape_rows(run.surfaces, settings.n_livers)
            run.rows += patient_rows(settings.n_base, settings.n_patient)

    def summary(self, run: Run[AccuracyTimeSettings]) -> dict[str, float]:
        rows, v = run.rows, run.kept["organ"]
        kept: Promises = run.kept["promises"]
        contacts: ForceErrors = run.kept["contacts"]
        best = _best(rows)
        return {
            "promise_kept_fraction": kept.errors_kept,
            "points_kept_fraction": kept.points_kept,
            "force_error_coverage": contacts.coverage,
            "force_error_overestimate": contacts.overestimate,
            "budgets_as_enumerated": float(column(_of(rows, "choose"), "as_enumerated").mean()),
            "front_points": sum(bool(row.get("front")) for row in rows),
            "l2_95": best["error"],
            **_beside_table(rows, v),
            "force_95": float(np.quantile(contacts.error / contacts.force, 0.95)),
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
            f"for {summary['promise_kept_fraction']:.1%} of fresh loads, the error said with a "
            f"force covered {summary['force_error_coverage']:.1%} of contacts"
        )

    def report(self, run: Run[AccuracyTimeSettings]) -> None:
        """Write the page."""
        panels = run.kept["panels"] = _panels(run.rows, run.kept["contacts"], run.summary)
        page = write_report(run.folder, self.name, run.sentence, run.summary, panels, run.rows)
        run.notices += [*short_table(run.rows), f"the page with all plots: {page}"]

    def draw(self, figure: Figure, run: Run[AccuracyTimeSettings]) -> None:
        panels = run.kept["panels"]
        shown = (panels[0], panels[2], panels[3])
        for axes, panel in zip(figure.subplots(1, 3, width_ratios=(5, 3, 3)), shown, strict=True):
            panel.draw(axes)


STUDY = AccuracyTimeStudy()


def short_table(rows: list[Row]) -> tuple[str, ...]:
    """The README's table: fastest steps within some errors, rivals, budgets; all vertices shown."""
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
    lines += [
        f"{row['tolerance']:.0%} in {row['deadline_us']:.0f} us: {row['setting']}"
        for row in _of(rows, "choose")
    ]
    return tuple(lines)


def _line(error: str, row: dict[str, Any], by: str) -> str:
    return (
        f"| {error} | {row['p50_us']:.0f} / {row['p99_us']:.0f} | {by} | {row['bytes'] / 1e6:.1f} |"
    )


def _best(rows: list[Row]) -> dict[str, Any]:
    """All modes, all vertices."""
    found = [r for r in _of(rows, "vademecum") if r.get("cloud") == "volume"]
    return min(found, key=lambda r: r["error"])


def _beside_table(rows: list[Row], vademecum: Vademecum) -> dict[str, float]:
    """The best error in the dense table's time, all vertices shown, and the memory over its own.

    Both hold what shows the displacement and what contact needs, without the tip field.
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

_QUANTITIES = {"mesh": "mesh, when refined (time of a build)", "grid": "grid (time of a level set)"}


def _panels(rows: list[Row], contacts: ForceErrors, summary: dict[str, float]) -> tuple[Panel, ...]:
    return (
        Panel("online", _online_sentence(rows), partial(_online, rows, "volume")),
        Panel(
            "surface",
            "The same for the vertices of the surface alone, which is what a display needs.",
            partial(_online, rows, "surface"),
        ),
        Panel(
            "force",
            f"The error said with each force against its true error, for unseen contacts: "
            f"{summary['force_error_coverage']:.1%} lie above the line, with a median of "
            f"{summary['force_error_overestimate']:.1f} times the true error.",
            partial(_force, contacts),
        ),
        Panel(
            "effects",
            "Time of a step with one effect each: what a scene does not name costs nothing.",
            partial(_effects, rows),
        ),
        Panel("offline", _offline_sentence(rows), partial(_offline, rows, ("mesh", "grid"))),
        Panel("loads", _load_sentence(rows), partial(_offline, rows, ("loads",))),
        Panel("shapes", _shape_sentence(rows), partial(_offline, rows, ("shape",))),
        Panel("patients", _patient_sentence(rows), partial(_offline, rows, ("patient",))),
    )


def _online_sentence(rows: list[Row]) -> str:
    volume = [row for row in rows if row.get("cloud") == "volume"]
    best, (table,) = _best(rows), _of(volume, "dense table")
    return (
        "Error of the displacement that a step shows against its time, all vertices: fewer modes "
        f"are faster and worse. The dense table is within {table['error']:.1%} instead of "
        f"{best['error']:.1%}, takes {_ratio(table, best, 'p50_us'):.1f} times as long and "
        f"{_ratio(table, best, 'bytes'):.0f} times the memory; one basis for all places, the best "
        "there is (SVD), stays behind."
    )


def _offline_sentence(rows: list[Row]) -> str:
    meshes = [row for row in rows if row["stage"] == "mesh"]
    finest = min((row for row in rows if row["stage"] == "grid"), key=lambda row: row["size"])  # type: ignore[arg-type,return-value]
    least, most = _ends([float(row["error"]) for row in meshes])  # type: ignore[arg-type]
    own = _ends([float(row["vademecum_error"]) for row in meshes])  # type: ignore[arg-type]
    return (
        "Error of the displacement against CPU time offline. Refining the mesh changes the answer "
        f"by {least:.1%} to {most:.1%}; on the same mesh the vademecum is {own[0]:.1%} to "
        f"{own[1]:.1%} wrong, whatever its size. Kept on the grid of a level set and read back, "
        f"displacements are {finest['error']:.1%} wrong at {finest['setting']}."
    )


def _load_sentence(rows: list[Row]) -> str:
    mine = [row for row in rows if row["stage"] == "loads"]
    (solved,), projected = _of(mine, "all solved"), _of(mine, "projected")
    last = min(projected, key=lambda row: row["size"])  # type: ignore[arg-type,return-value]
    return (
        "The response to every load, from the solutions for some of them and projection on these, "
        f"against all solutions: {last['error']:.2%} wrong in the mean, {last['worst']:.1%} at "
        f"worst, in {float(last['cpu_seconds']) / float(solved['cpu_seconds']):.2f} of their time."  # type: ignore[arg-type]
    )


def _shape_sentence(rows: list[Row]) -> str:
    shapes = sorted((r for r in rows if r["stage"] == "shape"), key=lambda r: r["error"])  # type: ignore[arg-type,return-value]
    (nearest,) = _of(shapes, "nearest neighbour")
    return (
        "Who writes a liver by the others, each left out: 1 - Dice, and the time of the weights. "
        f"Nearest of all comes {shapes[0]['setting']} ({shapes[0]['error']:.1%}); the nearest "
        f"neighbour alone is {nearest['error']:.1%} off."
    )


def _patient_sentence(rows: list[Row]) -> str:
    patients = [row for row in rows if row["stage"] == "patient"]
    least, most = _ends([float(r["error"]) for r in _of(patients, "interpolated")])  # type: ignore[arg-type]
    (reduced,), (solved,) = _of(patients, "reduced"), _of(patients, "solved")
    return (
        "How a new patient's vademecum is made from a base of bent phantoms (displacement; time of "
        f"the response alone): interpolated {least:.1%} to {most:.1%} wrong, with few or all "
        f"neighbours; reduced {reduced['error']:.1%}; all loads solved {solved['error']:.1%}, "
        "which is what a vademecum of so many modes leaves."
    )


def _ends(values: list[float]) -> tuple[float, float]:
    return min(values), max(values)


def _ratio(one: dict[str, Any], other: dict[str, Any], key: str) -> float:
    return float(one[key]) / float(other[key])


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
    axes.set_title(f"{cloud}: error against time online")


def _force(contacts: ForceErrors, axes: Axes) -> None:
    error, estimate = contacts.error / contacts.force, contacts.estimate / contacts.force
    axes.scatter(error, estimate, s=6, c="#0072B2", alpha=0.5, label="unseen contacts")
    ends = np.array([1e-4, 1.0])
    axes.plot(ends, ends, "k-", lw=1, label="said = true")
    axes.plot(ends, 3 * ends, "k:", lw=1, label="said = 3 x true")
    axes.axhline(JND, color="#888888", ls="-.", label=_NOTICED)
    axes.set_xlim(1e-4, 1.0)
    _logarithmic(axes, "true error of the force [-]", "error said with the force [-]")
    axes.set_title("error said with a force")


def _effects(rows: list[Row], axes: Axes) -> None:
    mine = [r for r in rows if r["stage"] == "effects"]
    names = [str(r["method"]) for r in mine]
    axes.barh(names, column(mine, "p99_us"), color="#56B4E9", label="p99")
    axes.barh(names, column(mine, "p50_us"), color="#0072B2", label="median")
    axes.invert_yaxis()
    axes.set_xlabel("time of a step [us]")
    axes.legend(loc="upper right", fontsize=8)
    axes.set_title("cost of effects")


def _offline(rows: list[Row], stages: tuple[str, ...], axes: Axes) -> None:
    colours = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
    mine = [r for r in rows if r["stage"] in stages]
    for colour, (stage, method) in zip(
        colours, dict.fromkeys((r["stage"], r["method"]) for r in mine), strict=False
    ):
        some = [r for r in mine if (r["stage"], r["method"]) == (stage, method)]
        some.sort(key=lambda row: row["size"])  # type: ignore[arg-type,return-value]
        seconds, errors = column(some, "cpu_seconds"), column(some, "error")
        label = method if len(stages) == 1 else _QUANTITIES[str(stage)]
        axes.plot(seconds, errors, "o-" if len(some) > 1 else "o", c=colour, label=label)
        for k, row in enumerate(some):
            axes.annotate(
                str(row["setting"]).split(", ")[-1],
                (seconds[k], errors[k]),
                xytext=(-4 if k % 2 else 4, 4),  # neighbours beside each other stay readable
                ha="right" if k % 2 else "left",
                textcoords="offset points",
                fontsize=7,
            )
        if stage == "mesh":
            own = column(some, "vademecum_error")
            axes.plot(seconds, own, "s--", c=colour, label="vademecum, on the same mesh")
    axes.margins(x=0.15)
    _logarithmic(axes, "CPU time [s]", "error [-]")
    axes.set_title(" and ".join(stages))


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
