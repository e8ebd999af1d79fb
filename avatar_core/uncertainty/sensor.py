"""Zero and lag of a force sensor, found from the forces along a path.

The vademecum's force f(t) along the same path gives both, whatever the true material.

Zero. Where the tip is clearly off the organ, a sensor measures its own zero.

Lag. An elastic organ's force F is a function of f in each touch, and f begins and ends at zero. The
integral

    C(tau) = integral of F(t + tau) df(t)

therefore vanishes where tau is the lag of F, the maximum of the integral of F(t + tau) f(t) dt.
Forces that lag give back more work than they took, which no tissue does: they are shifted. Tissue
that relaxes gives back less, C(0) > 0, like forces that run ahead. These two cannot be told apart.
The lost part of the work is therefore returned; half of it estimates
the excess of the forces on the way in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.contact.layout import lay_out
from avatar_core.contact.model import ContactModel, Status, step
from avatar_core.errors import StorageError
from avatar_core.geometry.tip import Tip
from avatar_core.uncertainty.material_grid import MaterialGrid
from avatar_core.vademecum.accuracy import Detail
from avatar_core.vademecum.model import Vademecum

_CLEAR = (
    1.5e-3  # between tip and surface, where nothing is touched: five deviations of its place [m]
)
_LEAST_OFF = 5  # samples off the organ that determine the zero
_MOST_LAG, _COARSE, _FINE = 0.4, 0.01, 0.003  # largest lag, and the steps of the search [s]
_LEAST_LAG = 2e-3  # lag below which forces are not shifted [s]
_SAID = 0.01  # least zero in a notice [N]
_PAUSE = 0.1  # for which a sample stands, at most [s]


@dataclass(frozen=True, eq=False)
class Sensed:
    """Forces on a path as a sensor with the right zero and no lag would have measured them.

    size : ndarray, shape (n,), size [N]; NaN where it is not known
    lost : part of the work of the way in that the way out does not give back
    notices : what was corrected, one line each
    """

    size: FloatArray
    lost: float
    notices: tuple[str, ...]


def sensed(
    vademecum: Vademecum, tip: Tip, time: FloatArray, position: FloatArray, force: FloatArray
) -> Sensed:
    """Take the sensor's zero and lag out of forces.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Rising [s].
    position : ndarray, shape (n, 3)
        Position of the tip [m]; not finite where it is not known.
    force : ndarray, shape (n, 3)
        Force in any axes that turn with the sensor or not at all [N].

    Raises
    ------
    StorageError
        If forces are measured, but none off the organ.
    """
    expected, off = _followed(vademecum, tip, position)
    off &= np.isfinite(force).all(axis=1)
    if off.sum() < _LEAST_OFF:
        if not (expected > 0.0).any():
            return Sensed(np.linalg.norm(force, axis=1), 0.0, ())  # refused later, by its cause
        raise StorageError(
            f"{off.sum()} forces were measured off the organ, and the sensor's zero is not known; "
            "record some before and between touches, 2 mm or more off the surface"
        )
    zero = np.median(force[off], axis=0)
    lag = _lag(time, np.linalg.norm(force - zero, axis=1), expected)
    notices = []
    if lag > _LEAST_LAG:
        force = np.column_stack([_at(time + lag, time, one) for one in force.T])
        zero = np.nanmedian(force[off], axis=0)
        notices.append(
            f"forces lag {1e3 * lag:.0f} ms behind the path, as the ways in and out show: moved; "
            "stamp poses and forces where they are measured"
        )
    if np.linalg.norm(zero) > _SAID:
        notices.append(
            "the sensor measures ({:.2f}, {:.2f}, {:.2f}) N off the organ: taken out of all "
            "forces".format(*zero)
        )
    size = np.linalg.norm(force - zero, axis=1)
    lost = 0.0 if lag > _LEAST_LAG else _lost(size, expected)
    return Sensed(size, lost, tuple(notices))


def _followed(
    vademecum: Vademecum, tip: Tip, position: FloatArray
) -> tuple[FloatArray, np.ndarray]:
    """Return force along a path [N], and whether the tip is clearly off the organ, (n,) each."""
    here = next(iter(MaterialGrid.of(vademecum).materials(vademecum)))
    model = ContactModel(lay_out(here, (tip,), Detail(1, "off")))
    data = model.data()
    force, off = np.zeros(len(position)), np.zeros(len(position), bool)
    for k in np.flatnonzero(np.isfinite(position).all(axis=1)):
        data.state.gap[0] = np.inf  # which a step leaves alone far away
        felt = step(model, data, position[k][None]) in (Status.OK, Status.EXTRAPOLATED)
        force[k] = felt * np.linalg.norm(data.out.force[0])
        off[k] = felt and data.state.gap[0] > _CLEAR
    return force, off


def _lag(time: FloatArray, size: FloatArray, expected: FloatArray) -> float:
    """Return the delay of forces against expected ones [s]; negative if forces run ahead."""
    weight = expected * np.minimum(np.gradient(time), _PAUSE)

    def overlap(lag: float) -> float:
        return float(np.nansum(weight * _at(time + lag, time, size)))

    tried = np.arange(-_MOST_LAG, _MOST_LAG + _COARSE / 2.0, _COARSE)
    best = float(tried[np.argmax([overlap(lag) for lag in tried])])
    for width in (_COARSE, _FINE):
        before, here, after = (overlap(best + side) for side in (-width, 0.0, width))
        curvature = 2.0 * here - before - after
        best += width * float(np.clip(0.5 * (after - before) / max(curvature, 1e-300), -1.0, 1.0))
    return best if abs(best) < _MOST_LAG - _COARSE else 0.0  # forces that have nothing of the path


def _lost(size: FloatArray, expected: FloatArray) -> float:
    """Return the fraction of the inward work that the outward path does not return, 0 to 1."""
    known = np.isfinite(size)
    middle = 0.5 * (size[known][1:] + size[known][:-1])
    work = middle * np.diff(expected[known])
    put_in = float(work[work > 0.0].sum())
    return float(np.clip(work.sum() / put_in, 0.0, 1.0)) if put_in > 0.0 else 0.0


def _at(when: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    """Return values at times between given ones; NaN outside them and beside NaN."""
    return np.asarray(np.interp(when, time, values, np.nan, np.nan))
