"""Data of a contact model, and steps without naming the model, for tests of a single loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from avatar_core.contact import model as contact
from avatar_core.contact.model import ContactData, ContactModel


def prepare(*arguments: Any, **options: Any) -> ContactData:
    """Prepare data of a new model; arguments of :func:`avatar_core.contact.model.model_of`."""
    return contact.model_of(*arguments, **options).data()


def data_of(arrays: Any) -> ContactData:
    """Prepare data of a model whose arrays are laid out already."""
    return ContactModel(arrays).data()


def step(data: ContactData, tips: np.ndarray, orientations: np.ndarray | None = None) -> int:
    return contact.step(data.model, data, tips, orientations)


def solve(data: ContactData, tips: np.ndarray, orientations: np.ndarray | None = None) -> int:
    return contact.solve(data.model, data, tips, orientations)


def deform(data: ContactData) -> None:
    contact.deform(data.model, data)


def estimate_error(data: ContactData) -> None:
    contact.estimate_error(data.model, data)


def turning(shaft: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the quaternion x y z w, shape (1, 4), that turns one unit vector into another."""
    half = np.append(np.cross(shaft, axis), 1.0 + shaft @ axis)
    if half[3] < 1e-12:  # half a turn, about any perpendicular line
        half[:3] = np.cross(shaft, np.eye(3)[np.argmin(np.abs(shaft))])
    return (half / np.linalg.norm(half))[None]
