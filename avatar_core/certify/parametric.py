"""Errors of a vademecum with coordinates: at values that its build did not use."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from avatar_core.certify.linear import certificate_of, measured
from avatar_core.fem.elasticity import Elasticity
from avatar_core.reduction.coordinates import Coordinate, problem_at
from avatar_core.vademecum.certificate import Certificate
from avatar_core.vademecum.model import Vademecum

_DRAWN = 6  # random values that a certificate is made at


def certify_range(
    vademecum: Vademecum,
    elasticity: Elasticity,
    n_loads: int = 200,
    seed: int = 0,
    progress: Callable[[int], None] = lambda done: None,
) -> Certificate:
    """Measure a vademecum on unseen loads at unseen values of its coordinates.

    The loads are divided among some random values and the ends of the range.
    """
    assert vademecum.parametric is not None
    values = _certified_values(vademecum.parametric.coordinates, seed)
    ends = np.linspace(0, max(n_loads, len(values)), len(values) + 1).astype(int)
    found = []
    for k, (point, n_each) in enumerate(zip(values, np.diff(ends).tolist(), strict=True)):
        here = vademecum.at(point)
        found.append(measured(here, problem_at(elasticity, point), n_each, seed + k))
        progress(int(ends[k + 1]))
    return certificate_of(vademecum, found, seed)


def _certified_values(coordinates: Sequence[Coordinate], seed: int) -> list[dict[str, float]]:
    """Return values drawn evenly in each coordinate's own scale, and both corners of the range."""
    rng = np.random.default_rng(seed)
    drawn = [{c.name: c.value_at(rng.random()) for c in coordinates} for _ in range(_DRAWN)]
    corners = [
        {c.name: end for c, end in zip(coordinates, ends, strict=True)}
        for ends in ([c.low for c in coordinates], [c.high for c in coordinates])
    ]
    return drawn + corners
