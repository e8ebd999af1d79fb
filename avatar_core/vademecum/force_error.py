"""Error estimate of the force on a tip.

The compliance that a contact step uses differs from the true one in two ways. Smoothing varies from
place to place and is known. The interpolation error between load positions is taken as uniform. The
estimate of the relative error at a place s is

    e(s) = factor [ smoothing(s) + floor ],

calibrated by split conformal prediction (Lei et al., JASA 113, 2018). ``factor`` is the quantile of
|F / F_FE - 1| / [ smoothing + floor ] over unseen loads that covers the asked fraction of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

COVERED = 0.925  # fraction of calibration contacts, so that fresh ones keep the promise
PROMISED = 0.9  # fraction of all contacts
_FLOORS = np.geomspace(2e-3, 0.2, 15)
_WORST_OVER_MEAN = 2.06  # 10 % of half-normal errors exceed this multiple of the mean


@dataclass(frozen=True)
class ForceError:
    """Calibrated estimate of the force error; NaN: there is none."""

    factor: float = float("nan")
    floor: float = float("nan")

    def relative(self, smoothing: np.ndarray, bending: float = 0.0) -> np.ndarray:
        """Return the relative error that one contact in ten may exceed.

        Parameters
        ----------
        smoothing : ndarray
            Relative change of the compliance by smoothing, any shape.
        bending : float
            Mean relative error that large deformation adds.
        """
        own = self.factor * (np.asarray(smoothing) + self.floor)
        return np.asarray(own + _WORST_OVER_MEAN * bending, np.float32)


def calibrated(smoothing: np.ndarray, error: np.ndarray) -> ForceError:
    """Return factor and floor from unseen contacts, both (n,).

    The floor maximises the likelihood of exponentially distributed errors.
    """
    n = len(error)
    if n == 0:
        return ForceError()

    def negative_log_likelihood(floor: float) -> float:
        scale = smoothing + floor
        return float(np.log(np.mean(error / scale)) + np.mean(np.log(scale)))

    floor = float(min(_FLOORS, key=negative_log_likelihood))
    rank = min(int(np.ceil(COVERED * (n + 1))), n)
    return ForceError(float(np.sort(error / (smoothing + floor))[rank - 1]), floor)
