"""Tips of every shape."""

from __future__ import annotations

from typing import get_args

from avatar_core.geometry.tip import USED_BY, Shape, Tip

USUAL = {"half_angle": 30.0, "rounding": 1.5e-3}


def used_by(shape: str) -> list[str]:
    """Return the names of the numbers that a shape needs beside its radius."""
    return [name for name, shapes in USED_BY.items() if shape in shapes]


def one_of_each() -> list[Tip]:
    """Return a tip of 4 mm of each shape."""
    return [
        Tip(shape, 4e-3, **{name: USUAL[name] for name in used_by(shape)})
        for shape in get_args(Shape)
    ]
