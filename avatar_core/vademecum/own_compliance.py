"""Contact compliance of each load position with itself, at other values of the coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from avatar_core.fem.elasticity import factors_at
from avatar_core.fem.resection import opened_to
from avatar_core.fem.supports import with_stiffness
from avatar_core.reduction.coordinates import RESECTION, node_weights, stiffness_of
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.parametric import combined, galerkin_load, stiffness_root


def own_compliance_at(vademecum: Vademecum, values: Mapping[str, float]) -> np.ndarray:
    """Return the contact compliance of each load position with itself, (n_positions, 3, 3) [m/N].

    Young's modulus is the one for which the coordinates are computed. It takes a small part of the
    time of :meth:`avatar_core.vademecum.model.Vademecum.at`.

    Parameters
    ----------
    values : Mapping[str, float]
        Values of all coordinates, by name; within their ranges.
    """
    parametric, near = vademecum.parametric, vademecum.contact_near
    own = np.flatnonzero(near.position == near.target)
    if parametric is None:
        return own_compliance(vademecum)
    poisson = values.get("poisson", vademecum.material.poisson_ratio)
    material = replace(
        vademecum.material, young_modulus=parametric.young_modulus, poisson_ratio=poisson
    )
    supports = with_stiffness(vademecum.supports, stiffness_of(values))
    resection = opened_to(vademecum.resection, values.get(RESECTION))
    contrast = values.get("contrast", vademecum.contrast)
    factors = factors_at(material, contrast, supports, resection)
    load = galerkin_load(parametric, stiffness_root(parametric, factors))
    weights = node_weights(parametric.coordinates, values)
    return _own_compliance(load, combined(parametric.contact_near[:, own], weights))


def own_compliance(vademecum: Vademecum) -> np.ndarray:
    """Return the same compliance at a vademecum's present values, (n_positions, 3, 3) [m/N]."""
    near = vademecum.contact_near
    return _own_compliance(vademecum.contact_load, near.block[near.position == near.target])


def _own_compliance(load: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Return Y_j Y_j^T + the near block of j with itself."""
    rows = load.reshape(len(block), 3, -1)
    return np.asarray(rows @ rows.swapaxes(1, 2) + block)
