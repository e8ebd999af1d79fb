"""Ten minutes of simulated 1 kHz: nothing grows, nothing drifts, nothing unknown is said.

The tip wanders at random in and out of the liver. What it has put in never falls below minus what
the trapezoidal rule makes of every contact that ends within a step h: K h^2 / 8.
"""

from __future__ import annotations

import ctypes
import gc
import re
import tracemalloc
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from avatar_core.contact.effects import Friction, Viscoelasticity
from avatar_core.contact.model import ContactModel, Status, step
from tests.helpers.paths import ROOT
from tests.helpers.touching import AWAY, RADIUS, Spot, spots, touched

Figure = Callable[[str], None]
MINUTE = 60_000  # periods
PR_SET_THP_DISABLE = 41
STATES = ROOT / "msg_docs" / "contact_state.md"
SCENES = {
    "bare": ((), 1),
    "friction, viscoelastic, two tools": (
        (Friction(static=0.4, kinetic=0.3), Viscoelasticity((0.3, 0.25), (0.05, 0.5))),
        2,
    ),
}


def resident() -> int:
    """Memory of this process that is in no file, whether in RAM or swapped out [bytes]."""
    gc.collect()
    status = Path("/proc/self/status").read_text()
    return sum(1024 * int(kib) for kib in re.findall(r"(?:RssAnon|VmSwap):\s+(\d+) kB", status))


def items() -> int:
    """What all lists, dictionaries and sets hold: their memory grows too seldom to tell."""
    gc.collect()
    return sum(len(o) for o in gc.get_objects() if type(o) in (list, dict, set, deque))


def without_huge_pages() -> None:
    """Else the kernel joins pages every ten seconds, and counts those that nobody has touched."""
    ctypes.CDLL(None).prctl(PR_SET_THP_DISABLE, 1, 0, 0, 0)


def documented() -> set[int]:
    """Status codes of the page of contact_state."""
    codes = {int(code) for code in re.findall(r"^\| (\d+) `STATUS_", STATES.read_text(), re.M)}
    assert len(codes) > 5
    return codes


class Stretch(NamedTuple):
    """One wander between two resets: work of all tips after each period, and what bounds it."""

    lowest: float  # smallest work until then [J]
    least: float  # the same with the bound until then [J]
    bound: float  # of its error by the rule [J]
    contacts: float  # part of the periods with a force
    left: float  # displacement 14 s after the tips have left [m]


def wander(spot: Spot, n_tools: int, n: int, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """Tips (n_tools, 3): a damped random walk about the surface, slower than 0.3 m/s."""
    q, v = np.zeros((n_tools, 3)), np.zeros((n_tools, 3))
    q[:, 0] = 1e-3
    q[:, 1] = 15e-3 * np.arange(n_tools)
    home = q.copy()
    frame = np.array([spot.normal, spot.along, spot.across])
    base = spot.center + RADIUS * spot.normal
    kicks = rng.normal(size=(n, n_tools, 3))
    for k in range(n):
        v += 2.5e-3 * kicks[k] - 1e-3 * (3.0 * v + 60.0 * (q - home) * [1.0, 0.3, 0.3])
        v.clip(-0.3, 0.3, out=v)
        q += 1e-3 * v
        yield base + q @ frame


def stretch(
    model: ContactModel, spot: Spot, n: int, rng: np.random.Generator, seen: set[int]
) -> Stretch:
    """Wander, lift off, let the organ rest; statuses into ``seen``."""
    model.reset()
    n_tools = model.n_tools
    stiff = 1.0 / float(model.arrays.self_compliance[model.arrays.row >= 0].min())
    work = lowest = least = bound = 0.0
    touching = np.zeros(n_tools, bool)
    contacts = 0
    before, pressed = np.tile(AWAY, (n_tools, 1)), np.zeros((n_tools, 3))
    rise = np.zeros((n_tools, 3))  # of the force in the last period
    for k, tips in enumerate(wander(spot, n_tools, n, rng)):
        if k % 1999 == 1998:  # a pose that is none; the rule spans its period
            seen.add(step(model, np.full((n_tools, 3), np.nan)))
            continue
        seen.add(step(model, tips))
        force = model.out.force
        if k > 0:
            way = tips - before
            work -= 0.5 * float(((force + pressed) * way).sum())
            now = force.any(axis=1)
            changed = now != touching
            if changed.any():
                bound += stiff * float((way[changed] ** 2).sum()) / 8.0
                touching = now
            # F'' h^3 / 12 of the trapezoidal rule, of a force that is curved over the depth
            bent = np.linalg.norm(force - pressed - rise, axis=1) * np.linalg.norm(way, axis=1)
            bound += float(bent[~changed].sum()) / 12.0
            contacts += int(now.any())
        lowest, least = min(lowest, work), min(least, work + bound)
        before, pressed, rise = tips, force.copy(), force - pressed
    return Stretch(lowest, least, bound, contacts / n, 0.0)


def endure(scene: str, minutes: float, n_stretches: int) -> str:
    """What came of so many minutes, between as many rests as there are stretches."""
    without_huge_pages()
    effects, n_tools = SCENES[scene]
    model = touched(effects, n_tools)
    rng, seen, places = np.random.default_rng(7), set[int](), spots(30e-3)
    n_each = round(minutes * MINUTE / n_stretches)
    runs: list[Stretch] = []
    away = np.tile(AWAY, (n_tools, 1))
    memory: list[int] = []
    for k in range(n_stretches):
        run = stretch(model, places[k % 3], n_each, rng, seen)
        for _ in range(14_000 if n_tools > 1 else 1):  # 18 times the slowest creep
            seen.add(step(model, away))
        left = float(np.abs(model.out.cloud[:, 3:]).max())
        runs.append(run._replace(left=left))
        if k >= 3:  # the first touch every page of the model once
            memory.append(resident())
    grown = memory[-1] - memory[0]
    tracemalloc.start()
    before, held = tracemalloc.take_snapshot(), items()
    for tips in wander(places[0], n_tools, 2000, rng):
        step(model, tips)
    more = items() - held
    after = tracemalloc.take_snapshot()
    tracemalloc.stop()
    core = [tracemalloc.Filter(True, "*avatar_core*")]
    kept = sum(
        change.size_diff
        for change in after.filter_traces(core).compare_to(before.filter_traces(core), "lineno")
    )
    assert grown < 2**20, f"{grown} bytes more"
    assert kept < 4096, f"{kept} bytes of Python objects more"
    assert more < 200, f"{more} more items in lists, dictionaries and sets"
    touching = np.mean([run.contacts for run in runs])
    assert touching > 0.15
    for run in runs:
        assert run.least >= -1e-9
        assert run.left < 1e-9
    assert seen <= documented()
    assert {int(Status.OK), int(Status.INVALID_POSE)} <= seen
    worst = max(run.left for run in runs)
    return (
        f"{round(minutes * MINUTE):,} steps, {touching:.0%} in contact: {grown / 1024:.0f} KiB "
        f"grown, energy at least {1e6 * min(run.lowest for run in runs):.3f} uJ of "
        f"{-1e6 * min(run.bound for run in runs):.0f} uJ allowed, "
        f"{worst:.0e} m left, statuses {sorted(seen)}"
    )


def test_half_a_minute_changes_nothing(figure: Figure) -> None:
    figure(endure("bare", 0.5, 8))


@pytest.mark.long
@pytest.mark.parametrize("scene", SCENES)
def test_three_minutes_change_nothing(scene: str, figure: Figure) -> None:
    figure(endure(scene, 3.0, 12))
