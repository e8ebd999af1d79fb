"""The fields of a vademecum at values of its coordinates.

See :mod:`avatar_core.vademecum.parametric`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from avatar_core.common.supports import SUPPORT
from avatar_core.errors import CoordinateError
from avatar_core.fem.elasticity import Material, factors_at
from avatar_core.fem.resection import Resection, opened_to
from avatar_core.fem.supports import Support, with_stiffness
from avatar_core.reduction.block_field import BlockField
from avatar_core.reduction.coordinates import (
    RESECTION,
    Coordinate,
    fixed_support,
    node_weights,
    require_known,
    stiffness_of,
)
from avatar_core.reduction.near_field import LocalBlocks
from avatar_core.reduction.separated import SeparatedField
from avatar_core.vademecum.modal_mass import BodyResponse
from avatar_core.vademecum.parametric import (
    ParametricResponse,
    combined,
    field_at,
    galerkin_field,
    regional_load_of_basis,
    stiffness_root,
)


@dataclass(frozen=True)
class Valued:
    """The fields of a vademecum that depend on the values of its coordinates, by the same names."""

    material: Material
    contrast: float | None
    supports: tuple[Support, ...]
    resection: Resection | None
    far: SeparatedField
    field: BlockField
    trailing: np.ndarray
    contact_near: LocalBlocks
    body: BodyResponse | None


def at_values(
    here: Valued, parametric: ParametricResponse | None, values: Mapping[str, float]
) -> Valued:
    """Return the fields at chosen values; see :meth:`avatar_core.vademecum.model.Vademecum.at`."""
    given = dict(values)
    for name, value in given.items():
        try:
            given[name] = float(value)
        except (TypeError, ValueError) as error:
            raise CoordinateError(f"{name} is {value!r}; give a number") from error
    material = replace(here.material, young_modulus=given.pop("young", here.material.young_modulus))
    coordinates = parametric.coordinates if parametric else ()
    require_known(coordinates, given)
    stiffens = material.young_modulus != here.material.young_modulus
    if stiffens:
        _require_free(here, coordinates)
    if parametric is None or not (given or (stiffens and here.supports)):
        return _with_young_modulus(here, material)
    supports = with_stiffness(here.supports, stiffness_of(given))
    softer = parametric.young_modulus / material.young_modulus
    # u(E, k) = E0 / E u(E0, k E0 / E)
    at_reference = with_stiffness(supports, {s.name: softer * s.stiffness for s in supports})
    point = {"poisson": material.poisson_ratio, "contrast": here.contrast or 1.0, **given}
    point |= {SUPPORT + support.name: support.stiffness for support in at_reference}
    point.setdefault(RESECTION, here.resection.opened if here.resection else 0.0)
    point = {c.name: float(point[c.name]) for c in coordinates}
    _require_in_range(coordinates, point, softer)
    weights = node_weights(coordinates, point)
    material = replace(material, poisson_ratio=point.get("poisson", material.poisson_ratio))
    contrast = point.get("contrast", here.contrast)
    reference = replace(material, young_modulus=parametric.young_modulus)
    resection = opened_to(here.resection, point.get(RESECTION))
    # the tie softens with the organ: it stands for tissue, and u stays proportional to 1 / E
    factors = factors_at(reference, contrast, at_reference, resection)
    root = stiffness_root(parametric, factors)
    far, trailing, body = galerkin_field(parametric, root)
    field = here.field
    regional_load = regional_load_of_basis(
        parametric, parametric.projection, root, trailing, field.region
    )
    regional_load += combined(parametric.regional_load, weights)
    shared = far.load.reshape(len(regional_load), 3, far.rank).astype(np.float32)
    load = np.concatenate([shared, regional_load], axis=2)
    found = replace(
        here,
        material=reference,
        contrast=contrast,
        supports=supports,
        resection=resection,
        far=SeparatedField(far.space.astype(np.float32), far.load.astype(np.float32)),
        trailing=trailing.astype(np.float32),
        body=body,
        field=field_at(field, parametric.core, root, load),
        contact_near=replace(here.contact_near, block=combined(parametric.contact_near, weights)),
    )
    return _with_young_modulus(found, material)


def ranges(here: Valued, parametric: ParametricResponse | None) -> dict[str, tuple[float, float]]:
    """Return the lowest and highest value of each coordinate, by name, if no other is changed.

    "young" is included only if supports limit it.
    """
    coordinates = parametric.coordinates if parametric else ()
    out = {c.name: (c.low, c.high) for c in coordinates}
    young, least, most = here.material.young_modulus, 0.0, math.inf
    for support in here.supports:
        name = SUPPORT + support.name
        if parametric is None or name not in out:
            least = most = young
            continue
        low, high = (young / parametric.young_modulus * end for end in out[name])
        out[name] = low, high
        least = max(least, young * support.stiffness / high)
        most = min(most, young * support.stiffness / low)
    return out | ({"young": (least, most)} if here.supports else {})


def _require_free(here: Valued, coordinates: Sequence[Coordinate]) -> None:
    """Raise CoordinateError if a fixed support forbids another Young's modulus."""
    names = [c.name for c in coordinates]
    for support in here.supports:
        if SUPPORT + support.name not in names:
            raise fixed_support(support.name, here.material.young_modulus)


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


def _with_young_modulus(here: Valued, material: Material) -> Valued:
    """Return the vademecum with every compliance multiplied by E / E'."""
    softer = here.material.young_modulus / material.young_modulus
    if softer == 1.0:
        return replace(here, material=material)
    root = np.float32(np.sqrt(softer))
    far, contact = here.far, here.contact_near
    return replace(
        here,
        material=material,
        far=SeparatedField(root * far.space, root * far.load),
        body=here.body.mixed(root * np.eye(far.rank)) if here.body else None,
        field=here.field.softened(softer),
        trailing=root * here.trailing,
        contact_near=replace(contact, block=np.float32(softer) * contact.block),
    )
