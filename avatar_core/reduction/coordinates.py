"""Coordinates of a vademecum u(x, s, p), for material and supports: ranges at build time.

All coordinates enter the stiffness through affine factors of constant matrices
(:attr:`avatar_core.fem.elasticity.Elasticity.factors`). Everything that depends on them is
therefore a small problem. Responses are computed at a few nodes in each range; between them,
weights are those of (multi)linear interpolation in

    poisson   -log(1 - 2 nu), in which the response varies evenly towards incompressibility
    contrast   log c
    support.NAME    log k, of the stiffness per area of a support
    resection   r, the part of a cut that is opened (:mod:`avatar_core.fem.resection`)

Canonical PGD, one product of functions of place, load and each coordinate, is not used. It needs
several times as many modes. It also stagnates at 13 % of the displacement towards
incompressibility, where the energy norm measures only the change of volume.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from avatar_core.common.supports import LEAST_STIFFNESS, MOST_STIFFNESS, SUPPORT
from avatar_core.errors import CoordinateError

if TYPE_CHECKING:
    from avatar_core.fem.elasticity import Elasticity

RESECTION = "resection"
# Between nodes no farther apart, in the scales above, interpolation adds nothing to the error that
# can be measured (`avatar study coordinates`).
_SPACING = {"poisson": 2.4, "contrast": 1.9, "support": 3.1, RESECTION: 0.2}
LIMITS = {
    "poisson": (0.0, 0.4999),
    "contrast": (0.01, 100.0),
    "support": (LEAST_STIFFNESS, MOST_STIFFNESS),
    RESECTION: (0.0, 1.0),
}


@dataclass(frozen=True)
class Coordinate:
    """A parameter of the organ that may be chosen when the vademecum is used.

    Attributes
    ----------
    name : str
        "poisson" (Poisson's ratio), "contrast" (Young's modulus inside the tumour over that
        outside), "support.NAME" (stiffness per area of a support [N/m^3]) or "resection" (opened
        part of a cut).
    low, high : float
        Limits of its range.
    n_nodes : int
        Number of nodes at which the organ is solved, both ends included; 0 for as many as the range
        needs.

    Raises
    ------
    CoordinateError
        For an unknown name or a range that is empty or impossible.

    Examples
    --------
    >>> poisson = av.Coordinate("poisson", 0.40, 0.48)
    >>> poisson.nodes.round(3)
    array([0.4 , 0.48])
    """

    name: str
    low: float
    high: float
    n_nodes: int = 0

    def __post_init__(self) -> None:
        if self.kind not in LIMITS or self.name == "support":
            raise CoordinateError(
                f"coordinate '{self.name}' is unknown; there are poisson, contrast, "
                "support.NAME and resection"
            )
        least, most = LIMITS[self.kind]
        if not least <= self.low < self.high <= most:
            raise CoordinateError(
                f"coordinate {self.name}={self.low:g}:{self.high:g}: give LOW:HIGH with "
                f"{least:g} <= LOW < HIGH <= {most:g}"
            )
        span = self._scaled(self.high) - self._scaled(self.low)
        if span == 0.0:  # neighbors whose logarithms round to one number
            raise CoordinateError(
                f"coordinate {self.name}={self.low!r}:{self.high!r}: the range is empty to "
                "rounding; give a wider one"
            )
        if self.n_nodes == 0:
            object.__setattr__(self, "n_nodes", 1 + math.ceil(span / _SPACING[self.kind]))
        if self.n_nodes < 2:
            raise CoordinateError(f"coordinate {self.name}: give at least 2 nodes")

    @property
    def kind(self) -> str:
        """Kind of parameter: "poisson", "contrast", "support" or "resection"."""
        return "support" if self.name.startswith(SUPPORT) else self.name

    @classmethod
    def parse(cls, text: str) -> Coordinate:
        """Parse a coordinate from the command line, e.g. `poisson=0.40:0.49` or `0.40:0.49:5`."""
        name, _, span = text.partition("=")
        try:
            low, high, *nodes = span.split(":")
            (n_nodes,) = nodes or ["0"]
            return cls(name.strip(), float(low), float(high), int(n_nodes))
        except ValueError as error:
            raise CoordinateError(
                f"coordinate '{text}': write NAME=LOW:HIGH, for example poisson=0.40:0.49"
            ) from error

    def __str__(self) -> str:
        return f"{self.name}={self.low:g}:{self.high:g}:{self.n_nodes}"

    @property
    def nodes(self) -> np.ndarray:
        """Values at which responses are computed, ascending, shape (n_nodes,)."""
        return np.array([self.value_at(t) for t in np.linspace(0.0, 1.0, self.n_nodes)])

    def value_at(self, fraction: float) -> float:
        """Return the value at a fraction of the range, 0 to 1, in the coordinate's own scale."""
        low, high = self._scaled(self.low), self._scaled(self.high)
        value = self._unscaled(low + fraction * (high - low))
        return float(np.clip(value, self.low, self.high))  # not even rounding leaves the range

    def fraction(self, value: float) -> float:
        """Return the place of a value in the range, 0 to 1, in the coordinate's own scale."""
        low, high = self._scaled(self.low), self._scaled(self.high)
        return (self._scaled(value) - low) / (high - low)

    def weights(self, value: float) -> np.ndarray:
        """Return the weights of the nodes at a value.

        The weights are at least 0 and sum to 1; at most two differ from 0.

        Raises
        ------
        CoordinateError
            For a value out of range.
        """
        if not self.low <= value <= self.high:
            raise CoordinateError(
                f"{self.name} is {value:g}; this vademecum holds {self.low:g} to {self.high:g}"
            )
        place = self.fraction(value) * (self.n_nodes - 1)
        return np.maximum(0.0, 1.0 - np.abs(np.arange(self.n_nodes) - place))

    def _scaled(self, value: float) -> float:
        if self.name == RESECTION:
            return value
        return -math.log1p(-2.0 * value) if self.name == "poisson" else math.log(value)

    def _unscaled(self, scaled: float) -> float:
        if self.name == RESECTION:
            return scaled
        return 0.5 * -math.expm1(-scaled) if self.name == "poisson" else math.exp(scaled)


def node_values(coordinates: Sequence[Coordinate]) -> list[dict[str, float]]:
    """Return the values at every node of the grid that several coordinates span."""
    grids = product(*(coordinate.nodes for coordinate in coordinates))
    names = [coordinate.name for coordinate in coordinates]
    return [dict(zip(names, map(float, values), strict=True)) for values in grids]


def node_weights(coordinates: Sequence[Coordinate], values: Mapping[str, float]) -> np.ndarray:
    """Return the weights of :func:`node_values` at some values, shape (n_nodes,)."""
    weights = np.ones(1)
    for coordinate in coordinates:
        weights = np.outer(weights, coordinate.weights(values[coordinate.name])).ravel()
    return weights


def require_known(coordinates: Sequence[Coordinate], values: Mapping[str, float]) -> None:
    """Raise CoordinateError if a value is given for an unknown coordinate."""
    names = [coordinate.name for coordinate in coordinates]
    others = f" but {', '.join(names)}" if names else ""
    for name in values:
        if name not in names:
            raise CoordinateError(
                f"this vademecum has no coordinate '{name}'{others}; {remedy(name)}"
            )


def remedy(name: str) -> str:
    """Return how to get a coordinate, or the names that there are."""
    is_support = name.startswith(SUPPORT) and name != SUPPORT
    if is_support or (name in LIMITS and name != "support"):
        return f"build it with {option_of(name)}"
    return f"coordinates are {', '.join(LIMITS)}".replace("support", f"{SUPPORT}NAME")


def option_of(name: str) -> str:
    """Return the command-line option that makes a coordinate."""
    if name == RESECTION:
        return "--resection FILE"
    is_support = name.startswith(SUPPORT)
    kind = f"--support {name.removeprefix(SUPPORT)}" if is_support else f"--coordinate {name}"
    return f"{kind}=LOW:HIGH"


def fixed_support(name: str, young: float) -> CoordinateError:
    """Return the error that a support is no coordinate, so that Young's modulus [Pa] is fixed."""
    return CoordinateError(
        f"support {name} is fixed, and with it Young's modulus at {young:g} Pa; build with "
        f"--support {name}=LOW:HIGH to choose both"
    )


def stiffness_of(values: Mapping[str, float]) -> dict[str, float]:
    """Return the stiffness of supports [N/m^3], by their own names, among values by coordinate."""
    return {n.removeprefix(SUPPORT): k for n, k in values.items() if n.startswith(SUPPORT)}


def problem_at(elasticity: Elasticity, values: Mapping[str, float]) -> Elasticity:
    """Return the elastic problem at values of the coordinates; others keep their values."""
    poisson = values.get("poisson", elasticity.material.poisson_ratio)
    material = replace(elasticity.material, poisson_ratio=poisson)
    return elasticity.at(
        material, values.get("contrast"), stiffness_of(values), values.get(RESECTION)
    )
