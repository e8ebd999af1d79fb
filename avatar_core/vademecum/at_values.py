"""A vademecum at chosen values of its coordinates (:mod:`avatar_core.vademecum.parametric`)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from avatar_core.common.supports import SUPPORT
from avatar_core.errors import CoordinateError
from avatar_core.fem.elasticity import Material, factors_at
from avatar_core.fem.resection import opened_to
from avatar_core.fem.supports import with_stiffness
from avatar_core.reduction.coordinates import (
    RESECTION,
    Coordinate,
    fixed_support,
    node_weights,
    require_known,
    stiffness_of,
)
from avatar_core.reduction.separated import SeparatedField
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.parametric import (
    combined,
    field_at,
    galerkin_field,
    galerkin_load,
    regional_load_of_basis,
    stiffness_root,
)


def at_values(vademecum: Vademecum, values: Mapping[str, float]) -> Vademecum:
    """The vademecum at chosen values of its coordinates; takes some tenths of a second.

    Parameters
    ----------
    vademecum : Vademecum
    values : by name of a coordinate; what is not given keeps its value. "young" [Pa] is a
        coordinate of every vademecum: displacements are proportional to 1 / E. On supports it is
        their stiffness over E that they depend on, so that these must be coordinates too.

    Raises
    ------
    CoordinateError, MaterialError
        For a coordinate that is not there, or a value out of range.
    """
    given = dict(values)
    material = replace(
        vademecum.material, young_modulus=given.pop("young", vademecum.material.young_modulus)
    )
    parametric = vademecum.parametric
    coordinates = parametric.coordinates if parametric else ()
    require_known(coordinates, given)
    stiffens = material.young_modulus != vademecum.material.young_modulus
    if stiffens:
        _require_free(vademecum, coordinates)
    if parametric is None or not (given or (stiffens and vademecum.supports)):
        return _with_young_modulus(vademecum, material)
    supports = with_stiffness(vademecum.supports, stiffness_of(given))
    softer = parametric.young_modulus / material.young_modulus
    # u(E, k) = E0 / E u(E0, k E0 / E)
    at_reference = with_stiffness(supports, {s.name: softer * s.stiffness for s in supports})
    here = {"poisson": material.poisson_ratio, "contrast": vademecum.contrast or 1.0, **given}
    here |= {SUPPORT + support.name: support.stiffness for support in at_reference}
    here.setdefault(RESECTION, vademecum.resection.opened if vademecum.resection else 0.0)
    point = {c.name: float(here[c.name]) for c in coordinates}
    _require_in_range(coordinates, point, softer)
    weights = node_weights(coordinates, point)
    material = replace(material, poisson_ratio=point.get("poisson", material.poisson_ratio))
    contrast = point.get("contrast", vademecum.contrast)
    reference = replace(material, young_modulus=parametric.young_modulus)
    resection = opened_to(vademecum.resection, point.get(RESECTION))
    # the tie softens with the organ: it stands for tissue, and u stays proportional to 1 / E
    factors = factors_at(reference, contrast, at_reference, resection)
    root = stiffness_root(parametric, factors)
    far, trailing, body = galerkin_field(parametric, root)
    field = vademecum.field
    regional_load = regional_load_of_basis(
        parametric, parametric.projection, root, trailing, field.region
    )
    regional_load += combined(parametric.regional_load, weights)
    shared = far.load.reshape(len(regional_load), 3, far.rank).astype(np.float32)
    load = np.concatenate([shared, regional_load], axis=2)
    found = replace(
        vademecum,
        material=reference,
        contrast=contrast,
        supports=supports,
        resection=resection,
        far=SeparatedField(far.space.astype(np.float32), far.load.astype(np.float32)),
        trailing=trailing.astype(np.float32),
        body=body,
        field=field_at(field, parametric.core, root, load),
        contact_near=replace(
            vademecum.contact_near, block=combined(parametric.contact_near, weights)
        ),
    )
    return _with_young_modulus(found, material)


def own_compliance_at(vademecum: Vademecum, values: Mapping[str, float]) -> np.ndarray:
    """Contact compliance at each load position of a load there, (n_positions, 3, 3) [m/N].

    As of :func:`at_values` at the Young's modulus for which the coordinates are computed, without
    what does not belong to it: a small part of the time.

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
    """Return the same of a vademecum at the values that it has, (n_positions, 3, 3) [m/N]."""
    near = vademecum.contact_near
    return _own_compliance(vademecum.contact_load, near.block[near.position == near.target])


def _own_compliance(load: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Return Y_j Y_j^T + the near block of j with itself."""
    rows = load.reshape(len(block), 3, -1)
    return np.asarray(rows @ rows.swapaxes(1, 2) + block)


def ranges(vademecum: Vademecum) -> dict[str, tuple[float, float]]:
    """Return the lowest and highest value of each coordinate, by name, if no other is changed.

    "young" is among them only where supports limit it.
    """
    parametric = vademecum.parametric
    coordinates = parametric.coordinates if parametric else ()
    out = {c.name: (c.low, c.high) for c in coordinates}
    young, least, most = vademecum.material.young_modulus, 0.0, math.inf
    for support in vademecum.supports:
        name = SUPPORT + support.name
        if parametric is None or name not in out:
            least = most = young
            continue
        low, high = (young / parametric.young_modulus * end for end in out[name])
        out[name] = low, high
        least = max(least, young * support.stiffness / high)
        most = min(most, young * support.stiffness / low)
    return out | ({"young": (least, most)} if vademecum.supports else {})


def _require_free(vademecum: Vademecum, coordinates: Sequence[Coordinate]) -> None:
    """Raise CoordinateError if a fixed support forbids another Young's modulus."""
    names = [c.name for c in coordinates]
    for support in vademecum.supports:
        if SUPPORT + support.name not in names:
            raise fixed_support(support.name, vademecum.material.young_modulus)


def _require_in_range(
    coordinates: Sequence[Coordinate], point: Mapping[str, float], softer: float
) -> None:
    """Raise CoordinateError for a support out of the range that it has at Young's modulus."""
    for c in coordinates:
        if softer != 1.0 and c.kind == "support" and not c.low <= point[c.name] <= c.high:
            raise CoordinateError(
                f"{c.name} is {point[c.name] / softer:g} N/m^3; at this Young's modulus the "
                f"vademecum holds {c.low / softer:g} to {c.high / softer:g}; choose that, or build "
                f"it near this modulus with --young"
            )


def _with_young_modulus(vademecum: Vademecum, material: Material) -> Vademecum:
    """Everything that is a compliance, times E / E'."""
    softer = vademecum.material.young_modulus / material.young_modulus
    if softer == 1.0:
        return replace(vademecum, material=material)
    root = np.float32(np.sqrt(softer))
    far, contact = vademecum.far, vademecum.contact_near
    return replace(
        vademecum,
        material=material,
        far=SeparatedField(root * far.space, root * far.load),
        body=vademecum.body.mixed(root * np.eye(far.rank)) if vademecum.body else None,
        field=vademecum.field.softened(softer),
        trailing=root * vademecum.trailing,
        contact_near=replace(contact, block=np.float32(softer) * contact.block),
    )
