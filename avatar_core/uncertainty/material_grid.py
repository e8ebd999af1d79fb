"""Interpolation of a function of the material, from a few vademecums.

    f(p) ~ sum_n l_n(t(p)) f(p_n)

with l_n the Lagrange polynomials on Chebyshev's points (of the first kind) of the coordinates'
ranges, each in its own scale t, tensor-wise. The response is analytic in the coordinates, so that
the error falls geometrically with the points (Trefethen, Approximation Theory, 2013). Young's
modulus needs no point: forces at an imposed depth are proportional to it, with supports at the same
stiffness over E,

    F(E, k) = E / E0 F(E0, k E0 / E).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from avatar_core.common.arrays import FloatArray
from avatar_core.common.supports import SUPPORT
from avatar_core.reduction.coordinates import Coordinate
from avatar_core.uncertainty.known import uncertain
from avatar_core.vademecum.model import Vademecum

N_POINTS = 5  # for each coordinate
_FEWER, _LEAST = {3: 4}, 3  # for each of three, of more
_MOST_OUTSIDE = 0.01  # fraction of draws outside a support's range that needs no notice
_SLACK = 1e-9  # relative, for values at the ends of a range


@dataclass(frozen=True)
class MaterialGrid:
    """Chebyshev's points of coordinates of a vademecum.

    coordinates : all coordinates of the vademecum, or some
    young : Young's modulus at the points, E0 [Pa]
    n_each : number of points for each coordinate
    """

    coordinates: tuple[Coordinate, ...]
    young: float
    n_each: int

    @classmethod
    def of(cls, vademecum: Vademecum) -> MaterialGrid:
        """Return the grid of a vademecum; its fineness follows from the number of coordinates."""
        parametric = vademecum.parametric
        if parametric is None:
            return cls((), vademecum.material.young_modulus, 1)
        coordinates = uncertain(vademecum)
        n = len(coordinates)
        n_each = N_POINTS if n < 3 else _FEWER.get(n, _LEAST)
        return cls(coordinates, parametric.young_modulus, n_each)

    @property
    def n_points(self) -> int:
        """Number of points."""
        return self.n_each ** len(self.coordinates)

    def points(self) -> list[dict[str, float]]:
        """Return the values of the coordinates, by name, at every point."""
        fractions = chebyshev_points(self.n_each)
        grids = product(*([c.value_at(t) for t in fractions] for c in self.coordinates))
        names = [c.name for c in self.coordinates]
        return [dict(zip(names, point, strict=True)) for point in grids]

    def materials(self, vademecum: Vademecum) -> Iterator[Vademecum]:
        """Yield the vademecum at every point, some tenths of a second each."""
        reference = {"young": self.young} if self.coordinates else {}
        for point in self.points():
            yield vademecum.at(reference | point)

    def softer(self, values: Mapping[str, FloatArray]) -> FloatArray:
        """Return E / E0 at values of "young", shape (n,)."""
        return np.asarray(values["young"]) / self.young

    def weights(self, values: Mapping[str, FloatArray]) -> FloatArray:
        """Return weights of the points at values of all coordinates and "young", (n, n_points).

        Each value has the shape (n,).
        """
        weights = np.ones((len(np.asarray(values["young"])), 1))
        for coordinate in self.coordinates:
            at = np.asarray(values[coordinate.name])
            if coordinate.kind == "support":  # far from all else it changes little: the ends do
                at = np.clip(at / self.softer(values), coordinate.low, coordinate.high)
            own = lagrange([coordinate.fraction(float(v)) for v in at], self.n_each)
            weights = (weights[:, :, None] * own[:, None, :]).reshape(len(own), -1)
        return weights

    def notices(self, values: Mapping[str, FloatArray]) -> tuple[str, ...]:
        """Return a notice of each support whose stiffness over "young" is often out of range.

        Each value has the shape (n,). The nearest end of the range stands for draws outside.
        """
        found = []
        for c in self.coordinates:
            if c.kind != "support":
                continue
            at = np.asarray(values[c.name]) / self.softer(values)
            outside = np.mean((at < c.low * (1.0 - _SLACK)) | (at > c.high * (1.0 + _SLACK)))
            if outside > _MOST_OUTSIDE:
                low, high = c.low / self.young, c.high / self.young
                found.append(
                    f"{c.name} over young lies outside the {low:.3g} to {high:.3g} /m of the "
                    f"vademecum in {outside:.0%} of the draws, which take the nearer end; build it "
                    f"with a wider --support {c.name.removeprefix(SUPPORT)}=LOW:HIGH"
                )
        return tuple(found)


def chebyshev_points(n: int) -> FloatArray:
    """Return Chebyshev's points of the first kind on 0 to 1, ascending, shape (n,)."""
    angles = np.pi * (np.arange(n) + 0.5) / n
    return np.asarray(0.5 - 0.5 * np.cos(angles))


def lagrange(fractions: Sequence[float], n: int) -> FloatArray:
    """Return weights of n Chebyshev points at some places of the range, (n_places, n)."""
    nodes, at = chebyshev_points(n), np.asarray(fractions)[:, None]
    columns = []
    for k in range(n):
        others = np.delete(nodes, k)
        columns.append(np.prod((at - others) / (nodes[k] - others), axis=1))
    return np.stack(columns, axis=1)
