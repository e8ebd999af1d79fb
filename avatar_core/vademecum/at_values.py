"""A vademecum at chosen values of its coordinates (:mod:`avatar_core.vademecum.parametric`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from avatar_core.fem.elasticity import Material, factors_at
from avatar_core.reduction.coordinates import node_weights, require_known
from avatar_core.reduction.separated import SeparatedField
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.parametric import (
    combined,
    galerkin_field,
    regional_load_of_basis,
    stiffness_root,
)


def at_values(vademecum: Vademecum, values: Mapping[str, float]) -> Vademecum:
    """The vademecum at chosen values of its coordinates; takes some tenths of a second.

    Parameters
    ----------
    vademecum : Vademecum
    values : by name of a coordinate; what is not given keeps its value. "young" [Pa] is a
        coordinate of every vademecum: displacements are proportional to 1 / E.

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
    require_known(parametric.coordinates if parametric else (), given)
    if parametric is None or not given:
        return _with_young_modulus(vademecum, material)
    here = {"poisson": material.poisson_ratio, "contrast": vademecum.contrast or 1.0, **given}
    point = {c.name: float(here[c.name]) for c in parametric.coordinates}
    weights = node_weights(parametric.coordinates, point)  # first, as it refuses
    material = replace(material, poisson_ratio=point.get("poisson", material.poisson_ratio))
    contrast = point.get("contrast", vademecum.contrast)
    reference = replace(material, young_modulus=parametric.young_modulus)
    root = stiffness_root(parametric, factors_at(reference, contrast))
    far, trailing, body = galerkin_field(parametric, root)
    regional_load = regional_load_of_basis(parametric, root, trailing, vademecum.regional)
    regional_load += combined(parametric.regional_load, weights)
    at_reference = replace(
        vademecum,
        material=reference,
        contrast=contrast,
        far=SeparatedField(far.space.astype(np.float32), far.load.astype(np.float32)),
        trailing=trailing.astype(np.float32),
        body=body,
        regional=replace(vademecum.regional, load=regional_load),
        contact_near=replace(
            vademecum.contact_near, block=combined(parametric.contact_near, weights)
        ),
    )
    return _with_young_modulus(at_reference, material)


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
        regional=vademecum.regional.scaled(softer),
        trailing=root * vademecum.trailing,
        contact_near=replace(contact, block=np.float32(softer) * contact.block),
    )
