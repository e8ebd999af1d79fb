"""Step times of a vademecum and of its rivals, in one run.

Rivals: the dense table (all columns stored, same contact solve) and a prefactored direct solve.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numba
import numpy as np

from avatar_core.common.jit import compiled
from avatar_core.contact.cloud import shown_blocks
from avatar_core.contact.display import write_cloud
from avatar_core.contact.effects.several_tools import place_beside
from avatar_core.contact.locate import locate
from avatar_core.contact.model import ContactData, compiled_for, model_of, step
from avatar_core.contact.organ_response import assemble_own, near_along_normal
from avatar_core.contact.solvers import solve_contact
from avatar_core.contact.step import write_forces
from avatar_core.contact.tool_path import slide, starts_apart
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.tip import Tip
from avatar_core.reduction.block_field import BLOCK, POINTS
from avatar_core.tips.law import sample_law
from avatar_core.vademecum.accuracy import Cloud
from avatar_core.vademecum.model import Vademecum

Clock = Callable[[], float]  # in seconds
Kind = type[np.float32] | type[np.int16]  # type of the numbers of a table

RADIUS, DEPTH = 10e-3, 5e-3  # [m] of the benchmark's tip, and how deep it slides
SPHERE, PATCH = Tip("sphere", RADIUS), Tip("patch", RADIUS)
PASSES = 5  # slides that are timed; other processes disturb some of them
MAX_TABLE_BYTES = 2_000_000_000
# Names by the kind of their numbers.
TABLES: dict[Kind, str] = {np.float32: "dense table", np.int16: "dense table, 16 bits"}


@dataclass(frozen=True)
class StepRow:
    """Step times of one method.

    vertices : number of shown vertices
    p50_us, p99_us : times of the whole step, contact and full field, medians over five slides [us];
        NaN if it does not fit
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
    """Return the cloud that a step shows here: the displayed surface, or else all vertices."""
    return "volume" if vademecum.display is None else "surface"


def time_steps(vademecum: Vademecum, n_tools: int, modes: int | None = None) -> StepRow:
    """Slide ``n_tools`` spheres of 10 mm, 5 mm deep, with the field at all shown vertices.

    modes : number of shown modes at a place; None for all
    """
    model = model_of(vademecum, (SPHERE,) * n_tools, modes, shown_cloud(vademecum))
    data = model.data()
    return _timed("vademecum", vademecum, data, model.n_modes, _stepped(data))


def time_tip_over_patch(
    vademecum: Vademecum, modes: int, clock: Clock = time.process_time
) -> float:
    """Return the median step with a sphere over that with the patch alone, which is all linear.

    Both slide in turn; the ratio is the median over the pairs of slides.
    """
    tips = tool_paths(vademecum, 1)
    models = [model_of(vademecum, (tip,), modes, cloud="volume") for tip in (SPHERE, PATCH)]
    sphere, patch = (model.data() for model in models)

    def p50(data: ContactData) -> float:
        return float(np.median(one_pass(data, tips, _stepped(data), clock)[0]))

    return float(np.median([p50(sphere) / p50(patch) for _ in range(PASSES)]))


def time_dense_table(
    vademecum: Vademecum, n_tools: int, clock: Clock = time.perf_counter, kind: Kind = np.float32
) -> StepRow:
    """Time the same contacts and field from stored columns, with the same interpolation.

    kind : type of the stored numbers; in 16 bits each column has its own factor
    """
    cloud, name = shown_cloud(vademecum), TABLES[kind]
    n_v, n_s = POINTS * shown_blocks(vademecum, cloud), vademecum.surface.n_positions
    size = np.dtype(kind).itemsize * 9 * n_s * (n_v + n_s)
    if size > MAX_TABLE_BYTES:
        nan = float("nan")
        return StepRow(name, n_v, 0, n_tools, nan, 0, nan, nan, size)
    data, call = _dense(vademecum, n_tools, kind)
    row = _timed(name, vademecum, data, 0, call, clock)
    return replace(row, bytes=size)


def table_over_steps(
    vademecum: Vademecum, clock: Clock = time.process_time, kind: Kind = np.float32
) -> float:
    """Return the median step of a dense table over the vademecum's with all modes, one tool.

    Both slide in turn, so that a machine that slows down slows both. The ratio is the median over
    the pairs.
    """
    tips = tool_paths(vademecum, 1)
    data = model_of(vademecum, (SPHERE,), cloud=shown_cloud(vademecum)).data()
    dense, call = _dense(vademecum, 1, kind)

    def ratio() -> float:
        table = np.median(one_pass(dense, tips, call, clock)[0])
        return float(table / np.median(one_pass(data, tips, _stepped(data), clock)[0]))

    return float(np.median([ratio() for _ in range(PASSES)]))


def _stepped(data: ContactData) -> Callable[[np.ndarray], object]:
    """Return the step as a function of tips, for tools that do not turn."""
    return lambda tips: step(data.model, data, tips)


def _dense(
    vademecum: Vademecum, n_tools: int, kind: Kind = np.float32
) -> tuple[ContactData, Callable[[np.ndarray], object]]:
    """Return the data that the dense table uses, and its step."""
    cloud, linear = shown_cloud(vademecum), replace(vademecum, large=None)
    data = model_of(linear, (SPHERE,) * n_tools, cloud=cloud).data()
    tables = (*_stored(_columns(vademecum, cloud), kind), *_stored(_compliance(vademecum), kind))
    around = (data.model.table, data.table, *tables)
    compiled_step = compiled_for(_dense_step, *map(numba.typeof, around))

    def dense(tips: np.ndarray) -> None:
        data.state.tip[:] = tips
        compiled_step(*around)

    return data, dense


def _stored(table: np.ndarray, kind: Kind) -> tuple[np.ndarray, np.ndarray]:
    """Return a table (n_positions, 3, ...) as numbers of a kind, and the factor of each column."""
    factor = np.ones(table.shape[:2], np.float32)
    if kind is np.float32:
        return table, factor
    rest = tuple(range(2, table.ndim))
    factor = np.maximum(np.abs(table).max(axis=rest), np.finfo(np.float32).tiny) / 32767.0
    return np.rint(table / np.expand_dims(factor, rest)).astype(kind), factor.astype(np.float32)


def time_direct(
    elasticity: Elasticity, vademecum: Vademecum, n: int = 40, clock: Clock = time.perf_counter
) -> StepRow:
    """Time one back-substitution with the stored factor per step, one contact."""
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
    """Return the number of processes that compete for the machine, one-minute mean."""
    return os.getloadavg()[0]


def _timed(
    method: str,
    vademecum: Vademecum,
    data: ContactData,
    modes: int,
    call: Callable[[np.ndarray], object],
    clock: Clock = time.perf_counter,
) -> StepRow:
    n_tools = data.model.n_tools
    tips = tool_paths(vademecum, n_tools)
    passes = [one_pass(data, tips, call, clock) for _ in range(PASSES)]
    contacts = np.concatenate([contacts for _, contacts in passes])
    return StepRow(
        method,
        len(data.out.cloud),
        modes,
        n_tools,
        float(contacts.mean()),
        int(contacts.min()),
        float(np.median([np.median(micro) for micro, _ in passes])),
        float(np.median([np.quantile(micro, 0.99) for micro, _ in passes])),
        data.model.nbytes,
    )


def one_pass(
    data: ContactData,
    tips: np.ndarray,
    call: Callable[[np.ndarray], object],
    clock: Clock = time.perf_counter,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the times [us] and contacts of a path's steps in which all tools touch.

    tips : ndarray, shape (n, n_tools, 3) [m]
    clock : wall or processor clock [s]
    """
    times = np.empty(len(tips))
    contacts = np.empty(len(tips), int)
    for k in range(len(tips)):
        start = clock()
        call(tips[k])
        times[k] = clock() - start
        contacts[k] = data.out.n_contacts[0]
    kept = (np.arange(len(tips)) >= 200) & (contacts >= tips.shape[1])  # caches are warm by then
    return times[kept] * 1e6, contacts[kept]


def tool_paths(
    vademecum: Vademecum, n_tools: int, n: int = 4000, tip: Tip = SPHERE, depth: float | None = None
) -> np.ndarray:
    """Return the slides of a tip at a depth [m] that start far apart, shape (n, n_tools, 3)."""
    starts = starts_apart(vademecum, n_tools)
    if depth is None:  # a flat face that is found 5 mm inside may have been set there: no force
        depth = DEPTH if tip.offset > 0.0 else DEPTH / 2.0
    paths = [slide(vademecum, tip.offset, depth, n * 1e-4, position=start) for start in starts]
    return np.ascontiguousarray(np.stack(paths, axis=1))


def _columns(vademecum: Vademecum, cloud: Cloud) -> np.ndarray:
    """Return displacement in the blocks of a cloud under every load, shape (n_positions, 3, n)."""
    field, n_blocks = vademecum.field, shown_blocks(vademecum, cloud)
    out = np.empty((vademecum.surface.n_positions, 3, n_blocks * BLOCK), np.float32)
    for r in range(field.n_regions):
        here = np.flatnonzero(field.region == r)
        load = field.load[here, :, : field.count[1 + r]]
        moved = field.of_part(1 + r, load.reshape(-1, load.shape[2]).T)[:n_blocks]
        out[here] = moved.reshape(-1, 3 * len(here)).T.reshape(len(here), 3, -1)
    return out


def _compliance(vademecum: Vademecum) -> np.ndarray:
    """Return the compliance between all load positions, shape (n, 3, n, 3).

    The axes are position, direction, position, component.
    """
    load, near = vademecum.contact_load, vademecum.contact_near
    n = vademecum.surface.n_positions
    dense = (load @ load.T).reshape(n, 3, n, 3)
    for j in range(n):
        row = slice(near.start[j], near.start[j + 1])
        dense[j][:, near.target[row]] += near.block[row].transpose(2, 0, 1)
    return np.ascontiguousarray(dense, dtype=np.float32)


@compiled(fastmath=True)
def _dense_step(model, data, columns, size, compliance, softness):  # type: ignore[no-untyped-def]
    """Step like :func:`avatar_core.contact.model.step`, with stored columns instead of modes."""
    for t in range(data.tip.shape[0]):
        locate(model, data, t, data.tip[t])
        data.mode[t] = np.float32(0.0)
        if not data.active[t]:
            data.force[t] = 0.0
            continue
        _dense_column(data, t, t, compliance, softness, data.column[t])
        near = near_along_normal(data, t, data.column[t])
        assemble_own(model, data, t, near)
        sample_law(model, data, t, data.tip[t])
    _couple_dense(model, data, compliance, softness)
    solve_contact(model, data)
    write_forces(model, data)
    u = data.field[: columns.shape[2]]
    u[:] = np.float32(0.0)
    for t in range(data.tip.shape[0]):
        for i in range(data.n_nodes[t] if data.force[t] > 0.0 else 0):
            j, force = data.nodes[t, i], -data.weight[t, i, 0] * data.force[t]
            for c in range(3):
                row, f = columns[j, c], np.float32(force * data.normal[t, c] * size[j, c])
                for k in range(u.shape[0]):
                    u[k] += f * np.float32(row[k])
    write_cloud(model, data)


@compiled(fastmath=True)
def _couple_dense(model, data, compliance, softness):  # type: ignore[no-untyped-def]
    if model.several_tools.on:
        for t in range(data.passage.shape[0]):
            for s in range(data.passage.shape[0]):
                data.several_tools.near[t, s] = s != t
                if s != t and data.active[t] and data.active[s]:
                    column = data.several_tools.column[t, s]
                    _dense_column(data, t, s, compliance, softness, column)
                    place_beside(model, data, t, s)


@compiled(fastmath=True)
def _dense_column(data, t, s, compliance, softness, column):  # type: ignore[no-untyped-def]
    column[: data.n_nodes[s]] = 0.0
    for i in range(data.n_nodes[t]):
        j = data.nodes[t, i]
        for c in range(3):
            row = compliance[j, c]
            f = data.weight[t, i, 0] * data.normal[t, c] * softness[j, c]
            for q in range(data.n_nodes[s]):
                for d in range(3):
                    column[q, d] += f * row[data.nodes[s, q], d]
