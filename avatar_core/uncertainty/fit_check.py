"""Check whether a model can have made the forces of some touches: the misfit must be chance.

The misfit of a touch over its standard deviation, d, is taken for Student's t; its normal score is

    s = Phi^-1(T(d)).

If model and errors are as stated, scores are independent standard normal numbers, reduced only by
the fitted parameters. Two tests look for deviations.

Large. The sum of all s^2 is chi-square distributed. It finds errors that are larger than stated,
anywhere.

Local. A missing structure inside, e.g. a tumour, makes all touches around it deviate to one side,
by less the farther they are: as g_t = exp(-|x_t - c|^2 / L^2). Parameters imitate a part of this.
With G the derivatives of the deviations by the parameters, h = g - G (G^T G)^-1 G^T g remains. The
largest h . s / |h| over places c and reaches L is compared with that of drawn scores (a scan
statistic; Kulldorff, Communications in Statistics 26:1481, 1997).
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtri
from scipy.stats import chi2
from scipy.stats import t as student_t

from avatar_core.common.arrays import FloatArray

REACHES = (15e-3, 30e-3)  # L [m]: of small and large tumours
_N_DRAWN = 9999
_IMITATED = 0.1  # |h| over |g|, below which the parameters make up for all


def chance(
    deviations: FloatArray, places: FloatArray, derivatives: FloatArray, freedom: float
) -> float:
    """Return the probability that a fit is as bad by chance, from the worse of both tests.

    deviations : ndarray, shape (n,), d of each touch
    places : ndarray, shape (n, 3), places of the touches [m]
    derivatives : ndarray, shape (n, n_parameters), G
    freedom : degrees of freedom of Student's t
    """
    scores = normal_scores(deviations, freedom)
    n_left = max(len(scores) - derivatives.shape[1], 1)
    large = float(chi2.sf((scores**2).sum(), n_left))
    return min(1.0, 2.0 * min(large, local_chance(scores, places, derivatives)))


def normal_scores(deviations: FloatArray, freedom: float) -> FloatArray:
    """Return s = Phi^-1(T(d)), which keeps signs, shape (n,)."""
    lower = ndtri(student_t.cdf(-np.abs(deviations), freedom))
    return np.asarray(-np.sign(deviations) * lower)


def local_chance(scores: FloatArray, places: FloatArray, derivatives: FloatArray) -> float:
    """Return the probability that drawn scores (n,) deviate as much around a place as these."""
    shapes = _shapes(places, derivatives)
    if len(shapes) == 0:
        return 1.0
    drawn = np.random.default_rng(0).standard_normal((_N_DRAWN, len(scores)))
    largest = np.abs(drawn @ shapes.T).max(axis=1)
    found = np.abs(shapes @ scores).max()
    return float((1 + (largest >= found).sum()) / (1 + _N_DRAWN))


def _shapes(places: FloatArray, derivatives: FloatArray) -> FloatArray:
    """Return h / |h| around each touch for each reach, shape (n_shapes, n)."""
    square = ((places[:, None] - places) ** 2).sum(axis=-1)
    around = np.concatenate([np.exp(-square / reach**2) for reach in REACHES])
    basis = np.linalg.svd(derivatives, full_matrices=False)[0]
    left = around - around @ basis @ basis.T
    size = np.linalg.norm(left, axis=1)
    kept = size > _IMITATED * np.linalg.norm(around, axis=1)
    return np.asarray(left[kept] / size[kept, None])
