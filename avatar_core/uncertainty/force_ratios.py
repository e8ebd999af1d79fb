"""Ratios of the edges of a force's band to the force, by load position and depth.

A tip d deep has the force F on tissue of the modulus E*. With L = F / (s E*), it sinks by

    d = delta(L) + L s E* (gamma - c)

(:mod:`avatar_core.tips.law`); a patch by gamma F. The shape factor s depends on the surface alone.
The material enters by E* and gamma, the compliance of a load position with itself. Neither needs a
vademecum at every point of the coordinates. F is therefore computed at Chebyshev's points of the
uncertain coordinates and interpolated like in :mod:`avatar_core.uncertainty.material_grid`. Its
quantiles are those of draws.

Tissue is taken to be linear and at rest without the tool: forces are then proportional to Young's
modulus. With self-weight and other tools, whose own depths do not change, that is nearly so.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.ndimage import map_coordinates

from avatar_core.common.array_table import ArrayTable, allocate, sizes_of
from avatar_core.common.arrays import FloatArray
from avatar_core.common.splines import evaluate_all
from avatar_core.contact.data import DATA
from avatar_core.contact.error_map import is_reached
from avatar_core.contact.layout import MODEL
from avatar_core.contact.organ_response import closest_weights
from avatar_core.contact.tip_solver import loads_at_depths
from avatar_core.fem.elasticity import Material
from avatar_core.geometry.tip import Tip
from avatar_core.reduction.coordinates import RESECTION, Coordinate
from avatar_core.tips.kept_factors import factors_of
from avatar_core.tips.law import LAW_STATE, PATCH_ON_MESH, law_arrays
from avatar_core.tips.shape_factor import dense
from avatar_core.uncertainty.bands import HIGH, LOW, drawn
from avatar_core.uncertainty.distributions import Distribution, Fixed
from avatar_core.uncertainty.material_grid import N_POINTS, MaterialGrid
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.own_compliance import own_compliance, own_compliance_at

DEPTHS = 0.5e-3 * 3.0 ** np.arange(4)  # for which forces are found [m]
DRAWS = 1000
MAX_POINTS = 625  # points of all coordinates together; with many coordinates, each has fewer


def log_edges(
    vademecum: Vademecum,
    tips: Sequence[Tip],
    known: Mapping[str, Distribution],
    draws: int = DRAWS,
    seed: int = 0,
) -> FloatArray:
    """Return ln of the forces that 5 and 95 % of the draws stay below.

    Parameters
    ----------
    vademecum : Vademecum
        Vademecum at any values.
    known : Mapping[str, Distribution]
        Distributions of all its parameters, by :func:`avatar_core.uncertainty.known.known_of`.
    draws, seed : int
        Number of draws, and their seed.

    Returns
    -------
    ndarray, shape (n_tips, n_positions, n_depths, 2)
    """
    parametric = vademecum.parametric
    young = parametric.young_modulus if parametric else vademecum.material.young_modulus
    opened = vademecum.resection.opened if vademecum.resection else 0.0
    every = {RESECTION: Fixed(opened), **known}
    coordinates = parametric.coordinates if parametric else ()
    constant = {c.name: _constant(c, every, young) for c in coordinates}
    free = [c for c in coordinates if constant[c.name] is None]
    grid = MaterialGrid(tuple(free), young, _n_points(len(free)))
    held = {name: value for name, value in constant.items() if value is not None}
    shapes = _shape_factors(vademecum, tips)
    found = np.stack([_at(vademecum, tips, shapes, held | point, young) for point in grid.points()])
    values = drawn(known, draws, seed)
    weights, stiffer = grid.weights(values), np.log(grid.softer(values))[:, None]
    edges = np.empty((*found.shape[1:], 2))
    for t, k in np.ndindex(found.shape[1], found.shape[3]):
        of_draws = np.exp(weights @ found[:, t, :, k] + stiffer)
        edges[t, :, k] = np.log(np.quantile(of_draws, (LOW, HIGH), axis=0)).T
    return edges


def force_spread_at(
    vademecum: Vademecum, tip: Tip, known: Mapping[str, Distribution], points: np.ndarray
) -> FloatArray:
    """Return half the width of the band that holds 90 % of the force, over its middle, (n,).

        (F_95 - F_5) / (F_95 + F_5)

    for a tip ``DEPTHS[1]`` deep, by :func:`log_edges`; NaN off the accessible surface.

    Parameters
    ----------
    known : Mapping[str, Distribution]
        Distributions of all its parameters, by :func:`avatar_core.uncertainty.known.known_of`.
    points : ndarray, shape (n, 3)
        Points of the surface at rest [m].
    """
    edges = log_edges(vademecum, (tip,), known)[0, :, 1]
    positions, weights = closest_weights(vademecum.surface, np.ascontiguousarray(points, float))
    width = np.sum(weights * np.ptp(edges, axis=1)[positions], axis=1)
    return np.where(is_reached(vademecum, points), np.tanh(0.5 * width), np.nan)


def log_forces(vademecum: Vademecum, tips: Sequence[Tip]) -> FloatArray:
    """Return ln of the forces at a vademecum's values, (n_tips, n_positions, n_depths)."""
    compliance = own_compliance(vademecum)
    shapes, v = _shape_factors(vademecum, tips), vademecum
    return _log_forces(v, tips, shapes, compliance, v.material, v.contrast)


def _at(
    vademecum: Vademecum,
    tips: Sequence[Tip],
    shapes: FloatArray,
    values: Mapping[str, float],
    young: float,
) -> FloatArray:
    """Return the same logarithms at values of all coordinates, and a Young's modulus [Pa]."""
    poisson = values.get("poisson", vademecum.material.poisson_ratio)
    compliance = own_compliance_at(vademecum, values)
    material = Material(young_modulus=young, poisson_ratio=poisson)
    contrast = values.get("contrast", vademecum.contrast)
    return _log_forces(vademecum, tips, shapes, compliance, material, contrast)


def _constant(
    coordinate: Coordinate, known: Mapping[str, Distribution], young: float
) -> float | None:
    """Return a coordinate's known value at the Young's modulus of the points [Pa], or None.

    None means that it varies. The stiffness of a support counts over Young's modulus, and varies
    with it.
    """
    one, modulus = known[coordinate.name], known["young"]
    if not isinstance(one, Fixed):
        return None
    if coordinate.kind != "support":
        return one.value
    if not isinstance(modulus, Fixed):
        return None
    return float(np.clip(one.value * young / modulus.value, coordinate.low, coordinate.high))


def _n_points(n_coordinates: int) -> int:
    """Return the number of Chebyshev's points for each coordinate."""
    return min(N_POINTS, max(3, int(MAX_POINTS ** (1.0 / max(n_coordinates, 1)) + 1e-9)))


def _log_forces(
    vademecum: Vademecum,
    tips: Sequence[Tip],
    shapes: FloatArray,
    compliance: FloatArray,
    material: Material,
    contrast: float | None,
) -> FloatArray:
    surface = vademecum.surface
    normals = surface.normals / np.linalg.norm(surface.normals, axis=1, keepdims=True)
    gamma = np.einsum("ia,iab,ib->i", normals, compliance, normals)
    pairs = zip(tips, shapes, strict=True)
    return np.log([_pressed(vademecum, *pair, gamma, material, contrast) for pair in pairs])


def _pressed(
    vademecum: Vademecum,
    tip: Tip,
    shape: FloatArray,
    gamma: FloatArray,
    material: Material,
    contrast: float | None,
) -> FloatArray:
    """Return forces on a tip at ``DEPTHS``, (n_positions, n_depths) [N].

    gamma : compliances at the same Young's modulus
    """
    law = _law(tip)
    if law is None:
        return np.asarray(DEPTHS / gamma[:, None])
    stiffness = np.full(len(gamma), material.plane_strain_modulus)
    if contrast is not None:
        tumour = _tumour_under(vademecum, tip)
        stiffness /= 1.0 - tumour + tumour / contrast
    taken = np.minimum(PATCH_ON_MESH / (stiffness * vademecum.surface.patch_radius), gamma)
    stiffness *= shape
    softness, load = stiffness * (gamma - taken), np.empty((len(DEPTHS), len(gamma)))
    for depth, found in zip(DEPTHS, load, strict=True):
        at = np.full(len(gamma), depth)
        loads_at_depths(*law, softness, at, found)
    return np.asarray((stiffness * load).T)


def _law(tip: Tip) -> tuple[ArrayTable, ArrayTable] | None:
    """Return the law of an upright tip, as model and data without an organ; None for a patch."""
    law = law_arrays((tip,), Material(), np.zeros((2, 0, 0, 0), np.float32))
    if law is None:
        return None
    nothing: defaultdict[str, int] = defaultdict(int)
    state = allocate(LAW_STATE, sizes_of(law))
    model, data = allocate(MODEL, nothing, law=law), allocate(DATA, nothing, law=state)
    return ArrayTable(model), ArrayTable(data)


def _shape_factors(vademecum: Vademecum, tips: Sequence[Tip]) -> FloatArray:
    """Return s where tips press each load position, at the middle depth, (n_tips, n_positions)."""
    field, surface = vademecum.tip_field, vademecum.surface
    shape = factors_of(field, tips)
    found = np.empty((len(tips), surface.n_positions))
    for row, tip, values in zip(found, tips, shape.value, strict=True):
        at = surface.centers + (tip.offset - np.median(DEPTHS)) * surface.normals
        whole = dense(values, shape.brick)
        evaluate_all(whole, field.origin, shape.spacing[0], at, row, np.empty_like(at))
    return np.exp(found)


def _tumour_under(vademecum: Vademecum, tip: Tip) -> FloatArray:
    """Return f where a tip touches each load position, (n_positions,)."""
    field, surface = vademecum.tip_field, vademecum.surface
    at = surface.centers + tip.offset * surface.normals
    grid = ((at - field.origin) / field.spacing[0]).T
    if field.tumour is None:
        return np.zeros(len(at))
    return map_coordinates(field.tumour, grid, order=2, prefilter=False, mode="nearest")
