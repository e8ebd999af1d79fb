"""Minutes of simulated 1 kHz: no growth, no drift, no unknown status.

The tip wanders at random in and out of the liver. The work put in never falls below minus the error
of the trapezoidal rule. That is K h^2 / 8 for every contact that ends within a step h.
"""

from __future__ import annotations

import ctypes
import gc
import re
from collections import deque
from pathlib import Path

import numpy as np
import pytest

from avatar_core.contact.effects import Effect, Friction, Viscoelasticity
from avatar_core.contact.model import ContactData, Status
from tests.helpers.coarse_liver import Spot, liver_model, spots
from tests.helpers.contact import step
from tests.helpers.paths import ROOT
from tests.helpers.tool_motion import AWAY, follow

MINUTE = 60_000  # periods
PR_SET_THP_DISABLE = 41
STATES = ROOT / "msg_docs" / "interfaces" / "contact_state.md"
SCENES: dict[str, tuple[tuple[Effect, ...], int]] = {
    "bare": ((), 1),
    "friction, viscoelastic, two tools": (
        (Friction(static=0.4, kinetic=0.3), Viscoelasticity((0.3, 0.25), (0.05, 0.5))),
        2,
    ),
}


def resident() -> int:
    """Return the memory of this process that is in no file, in RAM or swapped out [bytes]."""
    gc.collect()
    status = Path("/proc/self/status").read_text()
    return sum(1024 * int(kib) for kib in re.findall(r"(?:RssAnon|VmSwap):\s+(\d+) kB", status))


def items() -> int:
    """Count the entries of all lists, dictionaries and sets: their memory grows in rare steps."""
    gc.collect()
    return sum(len(o) for o in gc.get_objects() if type(o) in (list, dict, set, deque))


def without_huge_pages() -> None:
    """Disable huge pages, or the kernel joins pages every ten seconds and counts untouched ones."""
    ctypes.CDLL(None).prctl(PR_SET_THP_DISABLE, 1, 0, 0, 0)


def documented() -> set[int]:
    """Return the status codes on the page of contact_state."""
    codes = {int(code) for code in re.findall(r"^(\d+) `STATUS_", STATES.read_text(), re.M)}
    assert len(codes) > 5
    return codes


def wander(spot: Spot, n_tools: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return a damped random walk about the surface, below 0.3 m/s, shape (n, n_tools, 3)."""
    q, v = np.zeros((n_tools, 3)), np.zeros((n_tools, 3))
    q[:, 0] = 1e-3
    q[:, 1] = 15e-3 * np.arange(n_tools)
    home, path = q.copy(), np.empty((n, n_tools, 3))
    kicks = rng.normal(size=path.shape)
    for k in range(n):
        v += 2.5e-3 * kicks[k] - 1e-3 * (3.0 * v + 60.0 * (q - home) * [1.0, 0.3, 0.3])
        v.clip(-0.3, 0.3, out=v)
        q += 1e-3 * v
        path[k] = q
    return spot.tip(0.0) + path @ np.array([spot.normal, spot.along, spot.across])


def check_energy(data: ContactData, path: np.ndarray, force: np.ndarray) -> None:
    """Check that work so far plus the trapezoidal rule's error is never negative."""
    stiff = 1.0 / float(data.model.arrays.self_compliance[data.model.arrays.row >= 0].min())
    way, touching = np.diff(path, axis=0), force.any(axis=2)
    work = -0.5 * ((force[1:] + force[:-1]) * way).sum(axis=(1, 2))
    changed = touching[1:] != touching[:-1]
    missed = stiff * (way**2).sum(axis=2) / 8.0
    # F'' h^3 / 12 of the trapezoidal rule, for a force that is curved over the depth
    bent = np.diff(force, 2, axis=0, prepend=np.zeros_like(force[:1]))
    curved = np.linalg.norm(bent, axis=2) * np.linalg.norm(way, axis=2) / 12.0
    bound = np.where(changed, missed, curved).sum(axis=1)
    assert np.cumsum(work + bound).min() >= -1e-9


@pytest.mark.parametrize(
    ("scene", "minutes", "n_stretches"),
    [("bare", 0.5, 8), *(pytest.param(scene, 3.0, 12, marks=pytest.mark.long) for scene in SCENES)],
)
def test_minutes_change_nothing(scene: str, minutes: float, n_stretches: int) -> None:
    """Minutes of contact, separated by rests."""
    without_huge_pages()
    effects, n_tools = SCENES[scene]
    data = liver_model(effects, n_tools)
    rng, seen, places = np.random.default_rng(7), set[int](), spots(30e-3)
    away, contacts, memory = np.tile(AWAY, (n_tools, 1)), [], []
    for k in range(n_stretches):
        data.reset()
        path = wander(places[k % 3], n_tools, round(minutes * MINUTE / n_stretches), rng)
        path[1998::1999] = np.nan  # invalid poses; the rule spans their periods
        motion = follow(data, path)
        seen.update(motion.status.ravel().tolist())
        is_pose = np.isfinite(path[:, 0, 0])
        check_energy(data, path[is_pose], motion.force[is_pose])
        contacts.append(motion.force.any(axis=2).mean())
        for _ in range(14_000 if n_tools > 1 else 1):  # 18 times the slowest creep
            seen.add(step(data, away))
        assert np.abs(data.out.cloud[:, 3:]).max() < 1e-9
        if k >= 3:  # the first steps touch every page of the model once
            memory.append(resident())
    assert np.mean(contacts) > 0.15
    assert seen <= documented()
    assert {int(Status.OK), int(Status.INVALID_POSE)} <= seen
    grown = memory[-1] - memory[0]
    assert grown < 2**20, f"{grown} bytes more"
    path, before = wander(places[0], n_tools, 2000, rng), items()
    for tips in path:
        step(data, tips)
    more = items() - before
    assert more < 200, f"{more} more items in lists, dictionaries and sets"
