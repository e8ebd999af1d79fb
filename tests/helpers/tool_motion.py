"""Tools that move over an organ: forces, work and stored energy."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from avatar_core.contact.model import FAR_AWAY, ContactData, Status
from avatar_core.geometry.tip import Tip
from tests.helpers.contact import step
from tests.helpers.energies import stored_energy

AWAY = np.full(3, FAR_AWAY)


class Motion(NamedTuple):
    """Records along a path of n periods.

    force : ndarray, shape (n, n_tools, 3), force on the tools [N]
    status : ndarray, shape (n, n_tools)
    work : ndarray, shape (n,), work of the tools so far, by the trapezoidal rule [J]
    energy : ndarray, shape (n,), energy stored in the organ [J]
    """

    force: np.ndarray
    status: np.ndarray
    work: np.ndarray
    energy: np.ndarray


def follow(data: ContactData, path: np.ndarray) -> Motion:
    """Move the tools along a path, shape (n, n_tools, 3), one period for each row."""
    force, status = np.zeros(path.shape), np.zeros(path.shape[:2], int)
    energy = np.zeros(len(path))
    for k, tips in enumerate(path):
        step(data, tips)
        force[k], status[k] = data.out.force, data.out.status
        if force[k].any() and data.state.viscoelasticity is None:
            energy[k] = stored_energy(data)
    power = -0.5 * ((force[1:] + force[:-1]) * np.diff(path, axis=0)).sum(axis=(1, 2))
    return Motion(force, status, np.concatenate([[0.0], np.cumsum(power)]), energy)


def line(start: np.ndarray, end: np.ndarray, spacing: float) -> np.ndarray:
    """Return a straight path of one tip, both ends included, shape (n, 1, 3)."""
    n = max(2, int(np.ceil(np.linalg.norm(end - start) / spacing)) + 1)
    return np.linspace(start, end, n)[:, None, :]


def refined(corners: np.ndarray, n: int) -> np.ndarray:
    """Return the path from corner to corner, n steps for each leg, shape (n_steps, 3)."""
    legs = [np.linspace(a, b, n, endpoint=False) for a, b in pairwise(corners)]
    return np.concatenate([*legs, corners[-1:]])


def polygon(corners: Sequence[np.ndarray], spacing: float) -> np.ndarray:
    """Return straight lines of one tip from corner to corner, shape (n, 1, 3)."""
    return np.concatenate([line(a, b, spacing) for a, b in pairwise(corners)])


def press(
    data: ContactData,
    tips: Sequence[Tip],
    points: np.ndarray,
    normals: np.ndarray,
    depths: float | Sequence[float],
) -> np.ndarray:
    """Press tips from outside into an organ at rest; return the forces along the normals [N].

    points, normals : points of the surface and their normals, shape (n_tools, 3)
    """
    data.reset()
    height = np.array([tip.offset for tip in tips])
    for part in np.linspace(-0.2, 1.0, 13):
        status = step(data, points + (height - part * np.array(depths))[:, None] * normals)
    assert status == Status.OK
    return np.asarray((data.out.force * normals).sum(axis=1))


def energy_slope(
    data: ContactData, tips: np.ndarray, h: float = 1e-6, orientations: np.ndarray | None = None
) -> np.ndarray:
    """Differentiate the stored energy by the positions of all tips, shape (n_tools, 3) [N]."""
    slope = np.empty(tips.shape)
    for t, d in np.ndindex(*tips.shape):
        energy = []
        for change in (h, -h):
            moved = tips.copy()
            moved[t, d] += change
            step(data, moved, orientations)
            energy.append(stored_energy(data))
        slope[t, d] = (energy[0] - energy[1]) / (2.0 * h)
    return slope


def load_positions(data: ContactData) -> tuple[np.ndarray, np.ndarray]:
    """Return the load positions that carry the first tip, and their weights."""
    n = data.state.n_nodes[0]
    return data.state.nodes[0, :n], data.state.weight[0, :n, 0]
