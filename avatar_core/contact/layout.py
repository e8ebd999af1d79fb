"""The constant arrays of a step: a vademecum, tools and effects laid out flat.

``vademecum -> lay_out -> MODEL``; :mod:`avatar_core.contact.model` adds the compiled step and a
loop's data.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from avatar_core.common.array_table import array, kind
from avatar_core.contact.cloud import cloud_arrays, shown_vertices
from avatar_core.contact.display import DISPLAY, display_arrays
from avatar_core.contact.effects import (
    EFFECTS,
    Effect,
    Friction,
    Grasp,
    LargeDeformation,
    SeveralTools,
    Tumour,
)
from avatar_core.contact.effects.base import Ground, find
from avatar_core.contact.organ_response import TipCarriers, make_tip_response, tip_carriers
from avatar_core.errors import ContactError, SceneError
from avatar_core.geometry.tip import MAX_DEPTH, MAX_TOOLS, Tip
from avatar_core.reduction.block_field import BLOCK
from avatar_core.reduction.near_field import hash_rows
from avatar_core.tips.dent import DENT, dent_arrays
from avatar_core.tips.law import LAW, PATCH_ON_MESH, law_arrays
from avatar_core.tips.profile import STIFFNESS, TAKEN
from avatar_core.vademecum.accuracy import Cloud, Detail
from avatar_core.vademecum.certificate import Certificate

if TYPE_CHECKING:
    from avatar_core.tips.law import ShapeFactor
    from avatar_core.vademecum import large_deformation
    from avatar_core.vademecum.model import Vademecum

LANES = 32  # float32 numbers that a vectorised loop processes at once
PERIOD = 1e-3  # period of the steps [s]

# T tools, P load positions, K modes of contact, m of the cloud; on the grid of the tip field x y z.
MODEL = kind(
    "Model",
    # the tip field
    distance=array("x y z", np.float32),
    access=array("x y z", np.float32),
    origin=array("3"),
    spacing=array("1"),
    # the organ's response where a tip is
    row=array("x y z", np.int32),
    carrier=array("c w", np.int32),
    carrier_weight=array("c w", np.float32),
    self_compliance=array("x y z", np.float32),
    force_error=array("x y z", np.float32),  # relative
    # load positions [m], their modes, and the blocks of the near field with their hash table
    position=array("P 3"),
    load=array("P 3 K", np.float32),
    contact_start=array("q", np.int64),
    contact_slot=array("h 2", np.int32),
    contact_block=array("e 3 3", np.float32),
    softness=array("1"),  # added where access fades [m/N]
    superposed=array("1", np.bool_),  # whether all loads and histories add up at each tip
    moving=array("1", np.bool_),  # whether global modes move beside the loads of the moment
    # modes of the cloud's blocks; each part begins at block_start. The parts are global modes that
    # move beside the loads, the regions, and the regions' large deformation
    space=array(f"k {BLOCK}", np.int16),
    core=array("k m", np.float32),
    level=array("k", np.int32),
    block_start=array("parts blocks", np.int64),
    shown=array("1", np.int64),  # the level that is shown
    place=array("v", np.int32),  # place of each point in the blocks
    # regions of load positions, whose amplitudes begin at region_start
    region=array("P", np.int32),
    region_start=array("r", np.int64),
    regional_load=array("P 3 m", np.float32),
    rest=array("V 6", np.float32),  # the cloud without displacement [m]
    tip_offset=array("T"),  # height of a pose above the lowest point of the tip [m]
    # None where the load is the vademecum's own patch; and where the mesh's vertices are shown
    law=LAW,
    dent=DENT,
    display=DISPLAY,
    **{name: effect.Constants for name, effect in EFFECTS.items() if effect.Constants is not None},
)


@dataclass(frozen=True)
class Shape:
    """Shape of the organ and the tips in a layout, independent of the organ's material.

    Attributes
    ----------
    carriers : TipCarriers
        Load positions that carry a tip.
    reach : float
        Longest distance between the two positions of a block [m].
    factor : ShapeFactor
        Shape factor of each tip.
    """

    carriers: TipCarriers
    reach: float
    factor: ShapeFactor

    @classmethod
    def of(cls, vademecum: Vademecum, tips: Sequence[Tip]) -> Shape:
        """Return the shape, for several materials of an organ, or several clouds, at once."""
        # Here, because the contact node needs none of it.
        from avatar_core.tips.kept_factors import factors_of

        surface, field = vademecum.surface, vademecum.tip_field
        height = max(tip.offset for tip in tips)
        far = vademecum.contact_near.distances(surface.centers).max(initial=0.0)
        return cls(
            tip_carriers(surface, field, MAX_DEPTH, height),
            float(far) * (1.0 + 1e-9),
            factors_of(field, tips),
        )


def lay_out(
    vademecum: Vademecum,
    tips: Sequence[Tip] = (Tip(),),
    detail: Detail | None = None,
    effects: Sequence[Effect] | None = None,
    period: float = PERIOD,
    shape: Shape | None = None,
) -> Any:
    """Return the arrays of a contact model, a tuple of MODEL.

    For the other parameters see :func:`avatar_core.contact.model.model_of`.

    Parameters
    ----------
    detail : Detail or None
        Detail of the displacement; by default all modes at the surface.
    shape : Shape or None
        Shape of the organ and the tips, if it is known.
    """
    detail = detail or Detail(vademecum.n_modes)
    chosen = default_effects(vademecum, tips) if effects is None else effects
    _check(vademecum, tips, detail, chosen)
    if find(chosen, Grasp) and not find(chosen, Friction):
        chosen = (*chosen, Friction(0.0, 0.0))  # whose solver has forces of any direction
    without = () if find(chosen, Tumour) else (Tumour(1.0),)  # whose organ has none, if it can
    for effect in (*without, *chosen):
        vademecum = effect.adapted(vademecum)
    shape = shape or Shape.of(vademecum, tips)
    surface, contact, field = vademecum.surface, vademecum.contact_near, vademecum.tip_field
    contact_start, contact_slot = hash_rows(contact)
    load = vademecum.contact_load.reshape(surface.n_positions, 3, -1)
    modulus = vademecum.material.plane_strain_modulus
    response = make_tip_response(surface, field, shape.carriers, load, contact, modulus)
    large = vademecum.large if find(chosen, LargeDeformation) else None
    shown = cloud_arrays(vademecum, detail.cloud, large.terms if large else None)
    display = vademecum.display if detail.cloud == "surface" else None
    vertices = shown_vertices(vademecum, detail.cloud)
    points = display.vertices if display else vademecum.mesh.vertices[vertices]
    law = law_arrays(
        tips,
        vademecum.material,
        _local(vademecum, response.self_compliance),
        shape.factor,
        (vademecum.certificate or Certificate.unknown()).contact_sites.factor,
        large is not None and large.material == "neo-hookean",
    )
    places, fine = (surface.centers, surface.patch_radius), None
    if display:
        fine = display_arrays(
            display, shown.vertex, vademecum.blocks.place, vademecum.mesh.vertices, *places
        )
    padded = _padded(load)
    n_modes, start = padded.shape[2], shown.large_start
    ground = Ground(
        vademecum, tips, chosen, response, n_modes, float(shape.reach), start, float(period)
    )
    of_effects = {effect.name: effect.lay_out(ground) for effect in chosen if effect.Constants}
    return MODEL(
        distance=field.distance,
        access=field.access,
        origin=field.origin,
        spacing=field.spacing,
        row=response.row,
        carrier=response.carrier,
        carrier_weight=response.carrier_weight,
        self_compliance=response.self_compliance,
        force_error=force_error_grid(vademecum.certificate, large, response.smoothing),
        position=np.ascontiguousarray(surface.centers),
        load=padded,
        contact_start=contact_start,
        contact_slot=contact_slot,
        contact_block=contact.block,
        softness=np.array([float((load**2).sum(axis=(1, 2)).mean() / 3.0)]),
        superposed=np.array([any(effect.superposed for effect in chosen)]),
        moving=np.array([any(effect.moving for effect in chosen)]),
        space=shown.space,
        core=shown.core,
        level=shown.level,
        block_start=shown.block_start,
        shown=np.array([detail.modes]),
        place=vademecum.blocks.place[vertices],
        region=vademecum.field.region,
        region_start=shown.region_start,
        regional_load=shown.regional_load,
        rest=np.pad(points, ((0, 0), (0, 3))).astype(np.float32),
        tip_offset=np.array([tip.offset for tip in tips]),
        law=law,
        dent=dent_arrays(tips, points, *places) if law else None,
        display=fine,
        **{name: of_effects.get(name) for name in EFFECTS if name in MODEL.members},
    )


def default_effects(vademecum: Vademecum, tips: Sequence[Tip]) -> tuple[Effect, ...]:
    """Return effects of a scene that names none: those that vademecum and tools require."""
    effects: list[Effect] = []
    if vademecum.large is not None:
        effects.append(LargeDeformation())
    if vademecum.contrast is not None:
        effects.append(Tumour())
    if len(tips) > 1:
        effects.append(SeveralTools())
    if any(tip.grasp for tip in tips):
        effects.append(Grasp())
    return tuple(effects)


def _local(vademecum: Vademecum, self_compliance: np.ndarray) -> np.ndarray:
    """Return E* and c on the grid of the tip field, shape (2, nx, ny, nz) float32.

    A tumour of contrast q stores the fraction f of the energy under a tip. Over it, E* is the
    organ's divided by 1 - f + f / q.
    """
    stiffness = vademecum.material.plane_strain_modulus
    radius = vademecum.surface.patch_radius
    field, local = vademecum.tip_field, np.zeros((2, *self_compliance.shape), np.float32)
    local[STIFFNESS] = stiffness
    if field.tumour is not None and vademecum.contrast is not None:
        local[STIFFNESS] /= 1.0 - field.tumour + field.tumour / vademecum.contrast
    local[TAKEN] = np.minimum(PATCH_ON_MESH / (local[STIFFNESS] * radius), self_compliance)
    return local


def force_error_grid(
    certificate: Certificate | None,
    large: large_deformation.LargeDeformation | None,
    smoothing: np.ndarray,
) -> np.ndarray:
    """Return the relative force error on the grid of the tip field; NaN if it is not known.

    smoothing : of :class:`avatar_core.contact.organ_response.TipResponse`, or values of it
    """
    nonlinear = 0.0
    if large is not None:
        nonlinear = large.certificate.contact_mean if large.certificate else float("nan")
    return (certificate or Certificate.unknown()).force_error.relative(smoothing, nonlinear)


def _padded(load: np.ndarray) -> np.ndarray:
    """Return the loads with zeros up to a multiple of ``LANES`` modes."""
    return np.pad(load, ((0, 0), (0, 0), (0, -load.shape[2] % LANES)))


def _check(
    vademecum: Vademecum, tips: Sequence[Tip], detail: Detail, effects: Sequence[Effect]
) -> None:
    if not 1 <= len(tips) <= MAX_TOOLS:
        raise ContactError(f"{len(tips)} tools; give 1 to {MAX_TOOLS} tips")
    modes, most = detail.modes, vademecum.n_modes
    if not 1 <= modes <= most:
        raise ContactError(f"{modes} modes asked for; the vademecum has 1 to {most}")
    if detail.cloud not in get_args(Cloud):
        raise ContactError(
            f"cloud '{detail.cloud}' is unknown; choose {', '.join(get_args(Cloud))}"
        )
    for effect in effects:
        effect.require(vademecum)
    if len(tips) > 1 and find(effects, SeveralTools) is None:
        raise SceneError(
            f"{len(tips)} tools without several_tools; add it to the effects, or name one tool"
        )
