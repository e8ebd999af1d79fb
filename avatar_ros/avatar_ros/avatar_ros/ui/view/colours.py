"""Colours of the organ: tissue at rest, and a scale readable with colour vision deficiency.

The scale consists of bands, so that its edges are exact lines without colours in between. Below the
first edge the organ is drawn as tissue.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from avatar_ros.ui.view import tone

MAP = "viridis"  # as in the pictures; perceptually uniform, readable in grey
TOPS = (1e-3, 2e-3, 5e-3, 10e-3, 20e-3, 50e-3)  # possible ends of the scale [m]
N_BANDS = 20  # bands of the scale, the first of which is tissue
N_SHADES = 20  # shades of tissue, from its dark to its light side
TISSUE = (196, 112, 99)
CLAMP = ((70, 70, 70), (165, 165, 165))  # checks where the organ is clamped
SPRINGS = (70, 70, 70)  # hatching where springs hold the organ
ACCESS = (38, 84, 124)  # stripes where tools reach
MISSED = (240, 228, 66)  # parts of an organ that a template does not reach
HELD = (170, 170, 170)  # grey for a shape that is not the present one
_DARKEST, _LIGHTEST = 0.42, 1.15  # factors of the colour of tissue
_LIGHT = np.array([0.35, 0.75, 0.55])  # direction to the lamp: from the front, above, a bit right


@cache
def table() -> np.ndarray:
    """Return the colour map, shape (256, 3), from zero to the end of the scale; 0 to 1."""
    from matplotlib import colormaps

    return np.asarray(colormaps[MAP](np.arange(256))[:, :3], np.float32)


def colours(displacement: np.ndarray, top: float) -> np.ndarray:
    """Return colours by magnitude, shape (n, 3) float32, 0 to 1.

    Parameters
    ----------
    displacement : ndarray, shape (n, 3) [m]
    top : end of the scale [m]
    """
    size = np.sqrt(np.einsum("ij,ij->i", displacement, displacement))
    return table()[np.clip(size * (255.0 / top), 0, 255).astype(np.intp)]


def top_for(largest: float, before: float = TOPS[0]) -> float:
    """Return a scale's end that covers the largest displacement, not smaller than before [m]."""
    wanted = max(largest, before)
    return next((top for top in TOPS if top >= wanted), TOPS[-1])


@cache
def band_colours() -> np.ndarray:
    """Return the seen colours of the bands, shape (N_BANDS, 3), 0 to 255; the first is tissue."""
    middle = (np.arange(N_BANDS) + 0.5) / N_BANDS
    wanted = 255.0 * table()[np.round(255 * middle).astype(int)]
    wanted[0] = TISSUE
    return np.round(tone.shown(tone.material(wanted))).astype(int)


@cache
def scale_colours() -> np.ndarray:
    """Return the bands' colours with the scale's own first one, for fields where tissue differs."""
    wanted = 255.0 * table()[round(255 * 0.5 / N_BANDS)]
    first = np.round(tone.shown(tone.material(wanted))).astype(int)
    return np.vstack([first, band_colours()[1:]])


@cache
def tissue_colours(colour: tuple[int, int, int] = TISSUE) -> np.ndarray:
    """Return tissue from its dark to its light side, shape (N_SHADES, 3), 0 to 255."""
    return np.round(shaded(colour, (np.arange(N_SHADES) + 0.5) / N_SHADES)).astype(int)


def shaded(colour: tuple[int, int, int], light: np.ndarray) -> np.ndarray:
    """Return a colour under light of shape (n,), 0 to 1; shape (n, 3), 0 to 255."""
    part = _DARKEST + (_LIGHTEST - _DARKEST) * np.asarray(light)[:, None]
    return np.asarray(np.clip(part * np.array(colour), 0.0, 255.0))


def lightness(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return how light each vertex of a surface is, shape (n,), 0 to 1, by half Lambert."""
    corners = vertices[faces].astype(float)
    own = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.zeros((len(vertices), 3))
    for k in range(3):
        np.add.at(normal, faces[:, k], own)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    towards = normal @ (_LIGHT / np.linalg.norm(_LIGHT))
    return np.asarray(0.5 + 0.5 * towards)
