"""Bands of force and displacement, and the contribution of each parameter.

Draws are those of a Latin hypercube (McKay et al., Technometrics 21, 1979). A parameter's
contribution is its first-order Sobol index (Sobol, Math. Comput. Simul. 55, 2001). It is the part
of the variance of ln F that would vanish if the parameter were known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import qmc, sobol_indices

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import AvatarError, ContactError
from avatar_core.geometry.point_location import target_carriers
from avatar_core.geometry.tip import MAX_DEPTH, Tip
from avatar_core.uncertainty.distributions import Distribution, Fixed
from avatar_core.uncertainty.force_table import ForceTable, force_table
from avatar_core.uncertainty.known import known_of
from avatar_core.vademecum.model import Vademecum

LOW, HIGH = 0.05, 0.95  # the probabilities of a band's edges
_INDEX_DRAWS = 1024  # for each parameter, a power of two


@dataclass(frozen=True, eq=False)
class Bands:
    """Bands of force and displacement, for every place and depth.

    Attributes
    ----------
    places : ndarray, shape (n_places, 3)
        Load positions that are pressed [m].
    force : ndarray, shape (3, n_places, n_depths)
        Force on the tip at 5, 50 and 95 % [N].
    moved : ndarray, shape (3, n_places, n_depths)
        Displacement of the target at 5, 50 and 95 % [m].
    shares : mapping of str to ndarray, shape (n_places, n_depths)
        First-order Sobol index of each uncertain parameter for ln F [-].
    notices : tuple[str, ...]
        Supports that are often out of the vademecum's range, one line each.

    Examples
    --------
    >>> known = {"young": av.uncertainty.Lognormal(5e3, 1.5)}
    >>> bands = av.uncertainty.force_bands(v, known, [point], [1e-3, 3e-3])
    >>> low, median, high = bands.force[:, 0, 1]  # under 3 mm, at 5, 50 and 95 % [N]
    >>> low < median < high
    True
    """

    places: FloatArray
    force: FloatArray
    moved: FloatArray
    shares: Mapping[str, FloatArray]
    notices: tuple[str, ...] = ()


def force_bands(
    vademecum: Vademecum,
    known: Mapping[str, Distribution],
    points: ArrayLike,
    depths: ArrayLike,
    tip: Tip | None = None,
    target: ArrayLike | None = None,
    draws: int = 1000,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Bands:
    """Return bands of the force on a tip, and of a target's displacement, for uncertain material.

    Parameters
    ----------
    known : mapping of str to Distribution
        Young's modulus and coordinates of the vademecum, by name. A parameter that is not given
        keeps the vademecum's value.
    points : array_like, shape (n_places, 3)
        Places where the tip presses [m]. The load position nearest to each point is taken.
    depths : array_like, shape (n_depths,)
        Depths of the tip below the surface, rising [m].
    tip : Tip, optional
        The default is a sphere of 5 mm.
    target : array_like, shape (3,), optional
        Point whose displacement is asked for [m]. The default is the tumour, or the middle of the
        organ.
    draws : int
        Number of draws, at least 1.
    seed : int
        Seed of the draws, at least 0.
    progress : callable
        Called with the number of finished materials, and of all.

    Returns
    -------
    Bands

    Raises
    ------
    LoadError
        If a point lies more than 5 mm off the accessible surface.
    ContactError
        If the depths do not rise, the target lies more than 5 mm outside the organ, or no force
        acts on the tip.
    CoordinateError
        If the vademecum has no such parameter.
    AvatarError
        If there are no draws, or the seed is negative.

    Examples
    --------
    >>> u = av.uncertainty
    >>> known = {"young": u.Lognormal(5e3, 1.5), "poisson": u.Uniform(0.41, 0.47)}
    >>> bands = u.force_bands(v, known, [point], [1e-3, 3e-3])
    >>> bands.force.shape, bands.shares["young"][0, 0] > 0.9
    ((3, 1, 2), True)
    """
    deep = np.atleast_1d(np.asarray(depths, float))
    rise = deep.ndim == 1 and deep.size > 0 and (np.diff(deep, prepend=0.0) > 0.0).all()
    if not (rise and deep[-1] <= MAX_DEPTH):
        raise ContactError(
            f"depths are {deep.tolist()} m; give rising numbers above 0, up to {MAX_DEPTH:g}"
        )
    if draws < 1:
        raise AvatarError(f"{draws} draws span no band; give 1 or more, e.g. 1000")
    if seed < 0:
        raise AvatarError(f"the seed is {seed}; give 0 or more")
    centers, places = vademecum.surface.centers, []
    for point in np.asarray(points, float).reshape(-1, 3):
        vademecum.surface.nearest(point)  # refuses points off the surface
        places.append(int(np.argmin(np.linalg.norm(centers - point, axis=1))))
    all_known, aim = known_of(vademecum, known), _target(vademecum, target)
    table = force_table(vademecum, tip or Tip(), places, deep.tolist(), aim, progress)
    return bands_of(table, all_known, draws, seed)


def _target(vademecum: Vademecum, point: ArrayLike | None) -> FloatArray:
    """Return the point whose displacement is asked for, shape (3,) [m]."""
    if point is not None:
        target_carriers(vademecum.mesh, point, ContactError)  # refuses points outside
        return np.asarray(point, float)
    if vademecum.structures:
        assert vademecum.display is not None  # which holds them
        (faces, *_) = vademecum.structures.values()
        return np.asarray(vademecum.display.vertices[np.unique(faces)].mean(axis=0))
    return np.asarray(vademecum.mesh.vertices.mean(axis=0))


def drawn(known: Mapping[str, Distribution], n: int, seed: int) -> dict[str, FloatArray]:
    """Return the values of every parameter, each (n,)."""
    probability = qmc.LatinHypercube(len(known), rng=np.random.default_rng(seed)).random(n)
    columns = zip(known.items(), probability.T, strict=True)
    return {name: np.asarray(one.ppf(column)) for (name, one), column in columns}


def bands_of(
    table: ForceTable, known: Mapping[str, Distribution], n: int = 1000, seed: int = 0
) -> Bands:
    """Return the bands that n draws span, and each parameter's Sobol index."""
    values, levels = drawn(known, n, seed), (LOW, 0.5, HIGH)
    return Bands(
        table.places,
        np.quantile(table.force(values), levels, axis=0),
        np.quantile(table.moved(values), levels, axis=0),
        _shares(table, known, seed),
        table.grid.notices(values),
    )


def _shares(
    table: ForceTable, known: Mapping[str, Distribution], seed: int
) -> dict[str, FloatArray]:
    free = {name: one for name, one in known.items() if not isinstance(one, Fixed)}
    fixed = {name: one for name, one in known.items() if isinstance(one, Fixed)}
    shape = table.log_force.shape[1:]
    if len(free) < 2:
        return {name: np.ones(shape) for name in free}

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
