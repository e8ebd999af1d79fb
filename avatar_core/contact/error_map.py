"""Map of the expected force error on a tip over the surface."""

from __future__ import annotations

import igl
import numpy as np
from scipy.ndimage import map_coordinates

from avatar_core.contact.layout import force_error_grid
from avatar_core.contact.locate import FULL_ACCESS
from avatar_core.contact.organ_response import make_tip_response, tip_carriers
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.tip_field import TipField

_OFF = 5e-3  # largest distance of a point from the accessible surface [m]
_SHELL = 5e-3  # below and above the surface, in which the compliance is sampled [m]


def force_error_at(vademecum: Vademecum, points: np.ndarray) -> np.ndarray:
    """Return the relative error of the force that one contact in ten exceeds, shape (n,).

    :class:`avatar_core.vademecum.force_error.ForceError` estimates it. It is NaN off the accessible
    surface, and everywhere if the vademecum was not measured.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Points of the surface at rest [m].
    """
    field, surface = vademecum.tip_field, vademecum.surface
    load = vademecum.contact_load.reshape(surface.n_positions, 3, -1)
    carriers = tip_carriers(surface, field, _SHELL, _SHELL)
    modulus = vademecum.material.plane_strain_modulus
    response = make_tip_response(surface, field, carriers, load, vademecum.contact_near, modulus)
    grid = _in_spacings(field, points)
    smoothing = map_coordinates(response.smoothing.astype(float), grid, order=1, mode="nearest")
    error = force_error_grid(vademecum.certificate, vademecum.large, smoothing)
    return np.where(is_reached(vademecum, points), error, np.nan)


def is_reached(vademecum: Vademecum, points: np.ndarray) -> np.ndarray:
    """Return whether points (n, 3) [m] lie on the surface that tools reach, shape (n,)."""
    field, surface = vademecum.tip_field, vademecum.surface
    access = map_coordinates(
        field.access.astype(float), _in_spacings(field, points), order=1, mode="nearest"
    )
    square, _, _ = igl.point_mesh_squared_distance(
        np.ascontiguousarray(points, float), surface.centers, surface.corners
    )  # far from the accessible surface, nothing was sampled
    return np.asarray((access >= FULL_ACCESS) & (square < _OFF**2))


def _in_spacings(field: TipField, points: np.ndarray) -> np.ndarray:
    """Return the coordinates on the grid of a tip field, shape (3, n)."""
    return np.asarray(((np.asarray(points, float) - field.origin) / field.spacing[0]).T)
