"""Online accuracy against time: every point of the accuracy curve, and rivals, in one run.

Errors are the 95 % quantile over fresh contacts. The rivals' errors are taken where the tip
presses, and not through the stencil of a step. Times are whole steps on this machine.

    vademecum      global modes and those of the place's region, as a step shows it
    SVD optimum    the best basis for 150 solved loads, judged on others; one for all places
    dense table    exact columns at the load positions, interpolated between them
    direct solve   back-substitution with the stored factor; its error is zero by definition
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from avatar_core.certify.accuracy_curve import StepErrors
from avatar_core.certify.unseen_contacts import UnseenContacts, draw_contacts
from avatar_core.contact.effects import LargeDeformation
from avatar_core.contact.organ_response import closest_weights
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.norms import l2_norm, relative_l2
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.studies.bench.effects import cases_on, effect_rows
from avatar_core.studies.bench.methods import (
    StepRow,
    table_over_steps,
    time_dense_table,
    time_direct,
)
from avatar_core.studies.study import Row
from avatar_core.vademecum.accuracy import (
    CONTENT,
    AccuracyCurve,
    CurvePoint,
    Detail,
    upper_quantile,
)
from avatar_core.vademecum.model import Vademecum

N_SNAPSHOTS = 150  # loads, three directions each
_BATCH = 40


@dataclass(frozen=True, eq=False)
class Promises:
    """Certified errors against fresh touches.

    errors_kept : fraction of all pairs of a point and a fresh touch within the certified error
    points_kept : fraction of the points whose certified error holds for 95 % of the fresh touches
    """

    errors_kept: float
    points_kept: float


def promises(curve: AccuracyCurve, fresh: StepErrors) -> Promises:
    """Compare a curve with errors at fresh touches."""
    shown = [point for point in curve.points if point.detail.cloud != "off"]
    promised = np.array([point.l2 for point in shown])
    kept = fresh.shown <= promised[:, None]
    return Promises(float(kept.mean()), float(np.mean(kept.mean(axis=1) >= CONTENT)))


def curve_rows(curve: AccuracyCurve) -> list[Row]:
    """Return a curve's points; those on the front have no faster and better one of their cloud."""
    front = {id(p) for cloud in ("surface", "volume") for p in curve.of(cloud).front()}
    return [_row("vademecum", p, id(p) in front) for p in curve.points if p.detail.cloud != "off"]


def _row(method: str, point: CurvePoint, front: bool = False) -> Row:
    detail = point.detail
    return {
        "stage": "online",
        "method": method,
        "setting": str(detail),
        "cloud": detail.cloud,
        "modes": detail.modes,
        "error": point.l2,
        "force_error": point.force,
        "p50_us": 1e6 * point.p50,
        "p99_us": 1e6 * point.p99,
        "bytes": point.nbytes,
        "front": front,
    }


def rival_rows(
    vademecum: Vademecum, elasticity: Elasticity, curve: AccuracyCurve, n_loads: int, seed: int
) -> list[Row]:
    """Return the rivals with all vertices shown, on fresh loads, by processor time.

    The table's time is the curve's time with all modes, times the ratio of both in turns. The curve
    was timed minutes before, on a machine with neighbors.
    """
    surface, mass = vademecum.surface, vademecum.mesh.lumped_mass
    contacts = draw_contacts(vademecum, n_loads, seed)
    truth = np.stack([u.ravel() for _, u in contacts.solved(surface, elasticity)], axis=1)
    table = upper_quantile(_table_errors(vademecum, elasticity, contacts, truth, mass))
    drawn = np.random.default_rng(seed).permutation(len(surface.corners))[:N_SNAPSHOTS]
    return [
        *_optimum_rows(
            curve,
            _solutions(elasticity, surface.centroids[drawn], surface.patch_radius),
            truth,
            mass,
        ),
        _rival("dense table", table, _table_time(vademecum, curve)),
        # which works in several threads: the time of all of them
        _rival("direct solve", 0.0, time_direct(elasticity, vademecum, clock=time.process_time)),
    ]


def _table_time(vademecum: Vademecum, curve: AccuracyCurve) -> StepRow:
    """Return the time of a dense table, on the clock of the curve."""
    whole = Detail(vademecum.n_modes, "volume")
    (ours,) = (point for point in curve.points if point.detail == whole)
    row = time_dense_table(vademecum, 1, time.thread_time)
    p50 = 1e6 * ours.p50 * table_over_steps(vademecum, time.thread_time)
    return replace(row, p50_us=p50, p99_us=p50 * row.p99_us / row.p50_us)


def _rival(method: str, error: float, timing: StepRow) -> Row:
    return {
        "stage": "online",
        "method": method,
        "setting": timing.method,
        "cloud": "volume",
        "error": error,
        "p50_us": timing.p50_us,
        "p99_us": timing.p99_us,
        "bytes": timing.bytes,
        "front": False,
    }


def _solutions(elasticity: Elasticity, centers: np.ndarray, radius: float) -> np.ndarray:
    """Return full solutions for unit forces in x, y, z, shape (3 n_vertices, 3 n), load by load."""
    parts = [
        elasticity.at_vertices(elasticity.solve(patch_loads(elasticity, centers[batch], radius)))
        for batch in np.array_split(np.arange(len(centers)), -(-len(centers) // _BATCH))
    ]
    return np.hstack(parts)


def _table_errors(
    vademecum: Vademecum,
    elasticity: Elasticity,
    contacts: UnseenContacts,
    truth: np.ndarray,
    mass: np.ndarray,
) -> np.ndarray:
    """Return errors (n,) of exact columns at load positions, interpolated at contacts' places."""
    surface = vademecum.surface
    positions, weights = closest_weights(surface, contacts.place)
    needed, index = np.unique(positions, return_inverse=True)
    columns = _solutions(elasticity, surface.centers[needed], surface.patch_radius)
    columns = columns.reshape(len(columns), len(needed), 3)
    rows = zip(index.reshape(positions.shape), weights, contacts.normal, strict=True)
    found = np.stack([np.einsum("vid,i,d->v", columns[:, row], w, n) for row, w, n in rows], axis=1)
    return relative_l2(found, truth, mass)


def _optimum_rows(
    curve: AccuracyCurve, snapshots: np.ndarray, truth: np.ndarray, mass: np.ndarray
) -> list[Row]:
    """Return the best n modes for the snapshots, on other loads; as fast as ours of one region."""

    def scaled_of(field: np.ndarray) -> np.ndarray:
        return np.asarray(np.sqrt(mass)[:, None] * field / l2_norm(field, mass))

    basis = np.linalg.svd(scaled_of(snapshots), full_matrices=False)[0]
    scaled = scaled_of(truth)
    rows = []
    for point in curve.of("volume").points:
        best = basis[:, : point.detail.modes]
        left = np.linalg.norm(scaled - best @ (best.T @ scaled), axis=0)
        fast = CurvePoint(
            point.detail, upper_quantile(left), float("nan"), point.nbytes, point.p50, point.p99
        )
        rows.append(_row("SVD optimum", fast))
    return rows


def cost_of_effects(vademecum: Vademecum) -> list[Row]:
    """Return times of a step with each effect alone that a linear vademecum supports.

    The cloud is the surface or the volume.
    """
    every = cases_on(vademecum)
    cases = [case for case in every if not isinstance(case[2][0], LargeDeformation)]
    return [
        {
            "stage": "effects",
            "method": row.scene,
            "setting": f"{row.tools} tool" + ("s" if row.tools > 1 else ""),
            "p50_us": row.p50_us,
            "p99_us": row.p99_us,
            "ratio": row.ratio,
            "bytes": row.bytes,
        }
        for row in effect_rows(vademecum, cases)
    ]


def fastest_within(rows: Sequence[Row], error: float) -> Row | None:
    """Return the fastest row of a vademecum within an error."""
    found = [row for row in rows if row["method"] == "vademecum" and row["error"] <= error]  # type: ignore[operator]
    return min(found, key=lambda row: row["p50_us"], default=None)  # type: ignore[arg-type,return-value]
