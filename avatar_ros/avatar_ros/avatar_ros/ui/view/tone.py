"""Colours that a browser shows as given: unlit, and compensated for its tone mapping.

three.js maps the emitted colour by the filmic curve of ACES (as fitted by Stephen Hill),

    shown = Out f(In c / 0.6),  f(v) = (v (v + a) - b) / (v (c v + d) + e),

before it is encoded as sRGB. Under ambient light of intensity pi L alone, c is L times the
material's colour. The browser gets the inverse of both. A few bright, saturated colours are out of
reach; :func:`shown` gives the colour seen instead.
"""

from __future__ import annotations

import numpy as np

STRENGTH = 3.0  # L of the ambient light: bright enough for the lightest colours of the scale
AMBIENT = float(np.pi) * STRENGTH  # intensity of the only light
_EXPOSURE = 0.6
_IN = np.array(
    [[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]]
)
_OUT = np.array(
    [[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]]
)
_A, _B, _C, _D, _E = 0.0245786, 0.000090537, 0.983729, 0.4329510, 0.238081
_LARGEST = 0.99  # largest value that the curve reaches for a finite colour


def sent(shown: np.ndarray) -> np.ndarray:
    """Return the linear colour that must leave a surface to look like 0 to 255, shape (..., 3)."""
    wanted = np.minimum(_linear(np.asarray(shown, float) / 255.0) @ np.linalg.inv(_OUT).T, _LARGEST)
    square, line, rest = 1.0 - _C * wanted, _A - _D * wanted, -_B - _E * wanted
    root = (-line + np.sqrt(np.maximum(line**2 - 4.0 * square * rest, 0.0))) / (2.0 * square)
    return np.maximum(_EXPOSURE * root @ np.linalg.inv(_IN).T, 0.0)


def material(shown: np.ndarray) -> np.ndarray:
    """Return materials' colours, 0 to 255, that look like those given, 0 to 255, shape (..., 3)."""
    return np.round(255.0 * _encoded(np.minimum(sent(shown) / STRENGTH, 1.0))).astype(int)


def instance(shown: np.ndarray) -> np.ndarray:
    """Return :func:`material` for instances of a mesh, whose colours viser reads as linear."""
    return np.round(255.0 * np.minimum(sent(shown) / STRENGTH, 1.0)).astype(int)


def shown(given: np.ndarray) -> np.ndarray:
    """Return the seen colours of materials under that light, 0 to 255, shape (..., 3)."""
    v = STRENGTH * _linear(np.asarray(given, float) / 255.0) / _EXPOSURE @ _IN.T
    curve = (v * (v + _A) - _B) / (v * (_C * v + _D) + _E)
    return np.asarray(255.0 * _encoded(np.clip(curve @ _OUT.T, 0.0, 1.0)))


def _linear(encoded: np.ndarray) -> np.ndarray:
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _encoded(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
