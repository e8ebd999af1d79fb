"""Bands of force and displacement, and which parameter makes how much of them.

Draws are those of a Latin hypercube (McKay et al., Technometrics 21, 1979). A parameter's share is
its first-order Sobol index (Sobol, Math. Comput. Simul. 55, 2001): the part of the variance of
ln F that would go if the parameter were known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc, sobol_indices

from avatar_core.common.arrays import FloatArray
from avatar_core.uncertainty.distributions import Distribution, Fixed
from avatar_core.uncertainty.force_table import ForceTable

LOW, HIGH = 0.05, 0.95  # the probabilities of a band's edges
_INDEX_DRAWS = 1024  # for each parameter, a power of two


@dataclass(frozen=True, eq=False)
class Bands:
    """Of every place and depth.

    Attributes
    ----------
    force, moved : ndarray, shape (3, n_places, n_depths)
        Force and moved at 5, 50 and 95 % [N, m].
    shares : Mapping[str, ndarray]
        By parameter that is not fixed, ndarray (n_places, n_depths), of the force.
    """

    force: FloatArray
    moved: FloatArray
    shares: Mapping[str, FloatArray]


def drawn(known: Mapping[str, Distribution], n: int, seed: int) -> dict[str, FloatArray]:
    """Return the values of every parameter, each (n,)."""
    probability = qmc.LatinHypercube(len(known), rng=np.random.default_rng(seed)).random(n)
    columns = zip(known.items(), probability.T, strict=True)
    return {name: np.asarray(one.ppf(column)) for (name, one), column in columns}


def bands_of(
    table: ForceTable, known: Mapping[str, Distribution], n: int = 1000, seed: int = 0
) -> Bands:
    """Return the bands that n draws span, and each parameter's share of the force's."""
    values, levels = drawn(known, n, seed), (LOW, 0.5, HIGH)
    return Bands(
        np.quantile(table.force(values), levels, axis=0),
        np.quantile(table.moved(values), levels, axis=0),
        _shares(table, known, seed),
    )


def _shares(
    table: ForceTable, known: Mapping[str, Distribution], seed: int
) -> dict[str, FloatArray]:
    free = {name: one for name, one in known.items() if not isinstance(one, Fixed)}
    fixed = {name: one for name, one in known.items() if isinstance(one, Fixed)}
    shape = table.log_force.shape[1:]
    if not free:
        return {}

    def log_force(columns: FloatArray) -> FloatArray:
        values = dict(zip(free, columns, strict=True))
        values |= {name: one.ppf(columns[0]) for name, one in fixed.items()}
        found = np.log(table.force(values))
        return np.asarray(found.reshape(len(found), -1).T)

    indices = sobol_indices(
        func=log_force, n=_INDEX_DRAWS, dists=list(free.values()), rng=np.random.default_rng(seed)
    ).first_order
    shares = np.clip(np.nan_to_num(indices), 0.0, 1.0).reshape(*shape, len(free))
    return {name: shares[..., k] for k, name in enumerate(free)}
