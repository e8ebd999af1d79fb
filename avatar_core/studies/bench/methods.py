"""Step times of a vademecum and of its rivals, in one run.

Rivals: the dense table (all columns stored, same contact solve) and a prefactored direct solve.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from avatar_core.common.array_table import ArrayTable
from avatar_core.common.jit import compiled
from avatar_core.contact import kernels
from avatar_core.contact.cloud import shown_vertices
from avatar_core.contact.display import write_cloud
from avatar_core.contact.effects.selection import every_effect
from avatar_core.contact.effects.several_tools import place_beside
from avatar_core.contact.effects.tip_law import sample_organ
from avatar_core.contact.locate import locate
from avatar_core.contact.model import ContactModel, compiled_for, prepare, step
from avatar_core.contact.tip_compliance import assemble_own, near_along_normal
from avatar_core.contact.tool_path import slide, starts_apart
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.accuracy import Cloud
from avatar_core.vademecum.model import Vademecum

RADIUS, DEPTH = 10e-3, 5e-3  # [m] of the benchmark's tip, and how deep it slides
SPHERE, PATCH = Tip("sphere", RADIUS), Tip("patch", RADIUS)
PASSES = 5  # slides that are timed; other processes disturb some of them
MAX_TABLE_BYTES = 2_000_000_000

Clock = Callable[[], float]  # in seconds


@dataclass(frozen=True)
class StepRow:
    """Step times of one method.

    vertices : that are shown
    p50_us, p99_us : of the whole step, contact and full field, medians over five slides [us]; NaN
        if it does not fit
    contacts_mean, contacts_min : active contacts in the steps that were timed
    """

    method: str
    vertices: int
    modes: int
    tools: int
    contacts_mean: float
    contacts_min: int
    p50_us: float
    p99_us: float
    bytes: int


def shown_cloud(vademecum: Vademecum) -> Cloud:
    """What a step shows here: the displayed surface if there is one, or else all vertices."""
    return "volume" if vademecum.display is None else "surface"


def time_steps(vademecum: Vademecum, n_tools: int, modes: int | None = None) -> StepRow:
    """Slide ``n_tools`` spheres of 10 mm, 5 mm deep, with the field at all shown vertices.

    modes : that are shown at a place; None for all
    """
    model = prepare(vademecum, (SPHERE,) * n_tools, modes, shown_cloud(vademecum))
    shown = model.n_modes
    return _timed("vademecum", vademecum, model, shown, n_tools, lambda tips: step(model, tips))


def time_tip_over_patch(
    vademecum: Vademecum, modes: int, clock: Clock = time.process_time
) -> float:
    """Median step with a sphere over that with the patch alone, whose response is all linear.

    Both slide in turn; the median over the pairs of slides.
    """
    tips = tool_paths(vademecum, 1)
    models = [prepare(vademecum, (tip,), modes, cloud="volume") for tip in (SPHERE, PATCH)]

    def p50(model: ContactModel) -> float:
        return float(np.median(one_pass(model, tips, lambda at: step(model, at), clock)[0]))

    return float(np.median([p50(models[0]) / p50(models[1]) for _ in range(PASSES)]))


def time_dense_table(
    vademecum: Vademecum, n_tools: int, clock: Clock = time.perf_counter
) -> StepRow:
    """The same contacts and field from stored columns, displayed by the same interpolation."""
    cloud = shown_cloud(vademecum)
    n_v, n_s = len(shown_vertices(vademecum, cloud)), vademecum.surface.n_positions
    size = 4 * 9 * n_s * (n_v + n_s)
    if size > MAX_TABLE_BYTES:
        nan = float("nan")
        return StepRow("dense table", n_v, 0, n_tools, nan, 0, nan, nan, size)
    model, call = _dense(vademecum, n_tools)
    row = _timed("dense table", vademecum, model, 0, n_tools, call, clock)
    return replace(row, bytes=size)


def table_over_steps(vademecum: Vademecum, clock: Clock = time.process_time) -> float:
    """Median step of the dense table over that of the vademecum with all modes, one tool.

    Both slide in turn, so that a machine that slows down slows both; the median over the pairs.
    """
    tips = tool_paths(vademecum, 1)
    model = prepare(vademecum, (SPHERE,), cloud=shown_cloud(vademecum))
    dense, call = _dense(vademecum, 1)

    def ratio() -> float:
        table = np.median(one_pass(dense, tips, call, clock)[0])
        return float(table / np.median(one_pass(model, tips, lambda at: step(model, at), clock)[0]))

    return float(np.median([ratio() for _ in range(PASSES)]))


def _dense(
    vademecum: Vademecum, n_tools: int
) -> tuple[ContactModel, Callable[[np.ndarray], object]]:
    """A model whose state the dense table uses, and its step."""
    cloud = shown_cloud(vademecum)
    model = prepare(vademecum, (SPHERE,) * n_tools, cloud=cloud)
    columns, compliance = _columns(vademecum, cloud), _compliance(vademecum)
    arrays, state, out, _ = model.tables
    effects = ArrayTable(model.effects._replace(large_deformation=None), every_effect())
    around = (arrays, state, out, model.tips, effects, columns, compliance)
    compiled_step = compiled_for(_dense_step, *around)

    def dense(tips: np.ndarray) -> None:
        model.tips[:] = tips
        compiled_step(*around)

    return model, dense


def time_direct(
    elasticity: Elasticity, vademecum: Vademecum, n: int = 40, clock: Clock = time.perf_counter
) -> StepRow:
    """One back-substitution with the stored factor per step, one contact."""
    surface = vademecum.surface
    loads = patch_loads(elasticity, surface.centers[:n], surface.patch_radius).toarray()
    elasticity.solve(loads[:, :1])
    times = []
    for k in range(n):
        start = clock()
        elasticity.solve(loads[:, 3 * k : 3 * k + 1])
        times.append(clock() - start)
    micro = np.array(times) * 1e6
    return StepRow(
        f"direct solve ({elasticity.element})",
        len(vademecum.mesh.vertices),
        0,
        1,
        1.0,
        1,
        float(np.median(micro)),
        float(np.quantile(micro, 0.99)),
        elasticity.factor_bytes,
    )


def load_average() -> float:
    """Processes that compete for the machine, one-minute mean."""
    return os.getloadavg()[0]


def _timed(
    method: str,
    vademecum: Vademecum,
    model: ContactModel,
    modes: int,
    n_tools: int,
    call: Callable[[np.ndarray], object],
    clock: Clock = time.perf_counter,
) -> StepRow:
    tips = tool_paths(vademecum, n_tools)
    passes = [one_pass(model, tips, call, clock) for _ in range(PASSES)]
    contacts = np.concatenate([contacts for _, contacts in passes])
    return StepRow(
        method,
        len(model.out.cloud),
        modes,
        n_tools,
        float(contacts.mean()),
        int(contacts.min()),
        float(np.median([np.median(micro) for micro, _ in passes])),
        float(np.median([np.quantile(micro, 0.99) for micro, _ in passes])),
        model.nbytes,
    )


def one_pass(
    model: ContactModel,
    tips: np.ndarray,
    call: Callable[[np.ndarray], object],
    clock: Clock = time.perf_counter,
) -> tuple[np.ndarray, np.ndarray]:
    """Times [us] and contacts of the steps of one path in which all tools touch.

    tips : ndarray, shape (n, n_tools, 3) [m]
    clock : of the wall, or of the processor [s]
    """
    times = np.empty(len(tips))
    contacts = np.empty(len(tips), int)
    for k in range(len(tips)):
        start = clock()
        call(tips[k])
        times[k] = clock() - start
        contacts[k] = model.out.n_contacts[0]
    kept = (np.arange(len(tips)) >= 200) & (contacts >= tips.shape[1])  # caches are warm by then
    return times[kept] * 1e6, contacts[kept]


def tool_paths(vademecum: Vademecum, n_tools: int, n: int = 4000, tip: Tip = SPHERE) -> np.ndarray:
    """Slides of a tip that start far apart, shape (n, n_tools, 3)."""
    starts = starts_apart(vademecum, n_tools)
    # A flat face that is found 5 mm inside may have been set there, and is not felt.
    depth = DEPTH if tip.offset > 0.0 else DEPTH / 2.0
    paths = [slide(vademecum, tip.offset, depth, n * 1e-4, position=start) for start in starts]
    return np.ascontiguousarray(np.stack(paths, axis=1))


def _columns(vademecum: Vademecum, cloud: Cloud) -> np.ndarray:
    """Displacement of the mesh's points under every load, shape (n_positions, 3, 3 n_points)."""
    far, regional = vademecum.far, vademecum.regional
    n = vademecum.surface.n_positions
    points = shown_vertices(vademecum, cloud)
    rows = (3 * points[:, None] + np.arange(3)).ravel()
    out = (far.load @ far.space[rows].T).reshape(n, 3, -1).astype(np.float32)
    for r in range(regional.n_regions):
        at, modes = regional.region == r, regional.modes(r)[rows]
        out[at] += regional.load[at, :, : modes.shape[1]] @ modes.T
    return np.ascontiguousarray(out)


def _compliance(vademecum: Vademecum) -> np.ndarray:
    """Between all load positions, shape (n, 3, n, 3): position, direction, position, component."""
    load, near = vademecum.contact_load, vademecum.contact_near
    n = vademecum.surface.n_positions
    dense = (load @ load.T).reshape(n, 3, n, 3)
    for j in range(n):
        row = slice(near.start[j], near.start[j + 1])
        dense[j][:, near.target[row]] += near.block[row].transpose(2, 0, 1)
    return np.ascontiguousarray(dense, dtype=np.float32)


@compiled(fastmath=True)
def _dense_step(model, state, out, tips, effects, columns, compliance):  # type: ignore[no-untyped-def]
    """:func:`avatar_core.contact.model.step` with stored columns instead of modes."""
    e = effects
    for t in range(tips.shape[0]):
        locate(model, state, t, tips[t], e.superposition, e.tip_law)
        state.mode[t] = np.float32(0.0)
        if not state.active[t]:
            state.force[t] = 0.0
            continue
        _dense_column(state, t, t, compliance, state.column[t])
        near = near_along_normal(state, t, state.column[t])
        assemble_own(model, state, t, near)
        sample_organ(model, e.tip_law, t, tips[t])
    _couple_dense(state, e.several_tools, e.tip_law, compliance)
    kernels.solve_contact(model, state, tips, e)
    kernels.write_forces(model, state, out, tips, e)
    u = state.field[: columns.shape[2]]
    u[:] = np.float32(0.0)
    for t in range(tips.shape[0]):
        for i in range(state.n_nodes[t] if state.force[t] > 0.0 else 0):
            force = -state.weight[t, i, 0] * state.force[t]
            for c in range(3):
                row, f = columns[state.nodes[t, i], c], np.float32(force * state.normal[t, c])
                for k in range(u.shape[0]):
                    u[k] += f * row[k]
    write_cloud(model, state, out.cloud, e.tip_law, e.dent, e.display)


@compiled(fastmath=True)
def _couple_dense(state, several_tools, tip_law, compliance):  # type: ignore[no-untyped-def]
    if several_tools.on:
        for t in range(state.passage.shape[0]):
            for s in range(state.passage.shape[0]):
                several_tools.near[t, s] = s != t
                if s != t and state.active[t] and state.active[s]:
                    _dense_column(state, t, s, compliance, several_tools.column[t, s])
                    place_beside(state, several_tools, tip_law, t, s)


@compiled(fastmath=True)
def _dense_column(state, t, s, compliance, column):  # type: ignore[no-untyped-def]
    column[: state.n_nodes[s]] = 0.0
    for i in range(state.n_nodes[t]):
        for c in range(3):
            row = compliance[state.nodes[t, i], c]
            f = state.weight[t, i, 0] * state.normal[t, c]
            for q in range(state.n_nodes[s]):
                for d in range(3):
                    column[q, d] += f * row[state.nodes[s, q], d]
