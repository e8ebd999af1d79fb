"""The dent that a cloud shows near a tip, compared with that of a half-space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import igl
import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

from avatar_core.contact.model import ContactData
from avatar_core.geometry.tip import Tip
from avatar_core.tips.dent import REACH
from avatar_core.vademecum.display import boundary, display_of
from avatar_core.vademecum.model import Vademecum
from tests.helpers.box_organ import PATCH_RADIUS
from tests.helpers.contact import data_of
from tests.helpers.tool_motion import press

SPHERE, DEPTH = Tip("sphere", 3e-3), 2e-3
# offsets from the middle of a box [m]
ASIDE = ((0.0, 0.0), (3e-3, 2e-3), (-9e-3, 7e-3), (5e-3, 5e-3))
END = REACH * PATCH_RADIUS


def displaced(
    data: ContactData, tips: Sequence[Tip], places: np.ndarray, up: np.ndarray, depth: float
) -> np.ndarray:
    """Press tips to a depth from outside and return the cloud's displacements, (n, 3) [m]."""
    press(data, tips, places, up, depth)
    return np.asarray(data.out.cloud[:, 3:], float)


def with_patch_dents(data: ContactData) -> ContactData:
    """Return the same model with dents of patches only: no point is near a tip."""
    arrays = data.model.arrays
    return data_of(arrays._replace(dent=arrays.dent._replace(start=0 * arrays.dent.start)))


def tip_dent(tip: Tip, depth: float, a: float, rho: float) -> float:
    """Return u [m] of a half-space under a tip, by dimensionality reduction; a: contact radius."""
    end = min(a, rho)

    def spring(angle: float) -> float:
        x = end * np.sin(angle)
        w = depth - float(tip.depth(np.array(x)))
        return w * (end * np.cos(angle) / np.sqrt(rho * rho - x * x) if rho > end else 1.0)

    return 2.0 / np.pi * float(quad(spring, 0.0, 0.5 * np.pi, limit=200)[0])


def sneddon_dent(rho: np.ndarray) -> np.ndarray:
    """Return the displacement of a half-space under the sphere (Segedin, Sneddon) [m]."""
    radius = SPHERE.radius
    a = brentq(lambda a: a * np.arctanh(a / radius) - DEPTH, 1e-6, radius * (1.0 - 1e-9))
    return np.array([tip_dent(SPHERE, DEPTH, a, each) for each in rho])


def finer(v: Vademecum, times: int = 2) -> Vademecum:
    """Split every boundary triangle into four, repeatedly, and return the finer vademecum."""
    return replace(v, display=display_of(v.mesh, igl.upsample(*boundary(v.mesh), times)))
