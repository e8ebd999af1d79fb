"""Colours of displacements, distinguishable with colour vision deficiency."""

from __future__ import annotations

from functools import cache

import numpy as np

MAP = "viridis"  # as in the pictures; perceptually uniform, readable in grey
TOPS = (1e-3, 2e-3, 5e-3, 10e-3, 20e-3, 50e-3)  # possible ends of the scale [m]


@cache
def table() -> np.ndarray:
    """The colour map, shape (256, 3), from zero to the end of the scale; 0 to 1."""
    from matplotlib import colormaps

    return np.asarray(colormaps[MAP](np.arange(256))[:, :3], np.float32)


def colours(displacement: np.ndarray, top: float) -> np.ndarray:
    """Colours by magnitude, shape (n, 3) float32, 0 to 1.

    Parameters
    ----------
    displacement : ndarray, shape (n, 3) [m]
    top : end of the scale [m]
    """
    size = np.sqrt(np.einsum("ij,ij->i", displacement, displacement))
    return table()[np.clip(size * (255.0 / top), 0, 255).astype(np.intp)]


def top_for(largest: float, before: float = TOPS[0]) -> float:
    """The end of a scale that holds the largest displacement and never shrinks [m]."""
    wanted = max(largest, before)
    return next((top for top in TOPS if top >= wanted), TOPS[-1])
