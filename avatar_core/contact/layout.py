"""The constant arrays of a step: a vademecum, tools and effects laid out flat.

``vademecum -> lay_out -> Layout``; :mod:`avatar_core.contact.model` adds state and compiled code.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from avatar_core.contact import kernels
from avatar_core.contact.cloud import CloudArrays, cloud_arrays, rounded
from avatar_core.contact.dent import dent_arrays
from avatar_core.contact.display import display_arrays
from avatar_core.contact.effects.base import Effect
from avatar_core.contact.effects.large_deformation import (
    LargeDeformationArrays,
    LargeDeformationEffect,
)
from avatar_core.contact.effects.selection import (
    ARRAYS,
    Constants,
    adapted_vademecum,
    default_effects,
    find,
    own_motion,
    selected_arrays,
)
from avatar_core.contact.effects.several_tools import SeveralTools
from avatar_core.contact.effects.tilt import Tilt, tilt_arrays
from avatar_core.contact.effects.tip_law import PATCH_ON_MESH, tip_law_arrays
from avatar_core.contact.effects.tip_profile import STIFFNESS, TAKEN
from avatar_core.contact.kernels import ModelArrays
from avatar_core.contact.locate import MAX_DEPTH
from avatar_core.contact.tip_response import (
    TipCarriers,
    TipResponse,
    make_tip_response,
    sampled_at_tip,
    tip_carriers,
)
from avatar_core.errors import ContactError, SceneError
from avatar_core.geometry.tip import Tip
from avatar_core.reduction.near_field import hash_rows
from avatar_core.vademecum.accuracy import Cloud, Detail
from avatar_core.vademecum.certificate import Certificate

if TYPE_CHECKING:
    from avatar_core.contact.effects.tip_law import ShapeFactor
    from avatar_core.vademecum.large_deformation import LargeDeformation
    from avatar_core.vademecum.model import Vademecum

LANES = 32  # float32 numbers that a vectorised loop processes at once
PERIOD = 1e-3  # of the steps [s]


@dataclass(frozen=True)
class Layout:
    """The constant arrays of a step: of the organ and its tools, and of the chosen effects.

    arrays : ModelArrays
        distance, access, origin, spacing: the tip field; row, carrier, carrier_weight,
        self_compliance: the tip response on its grid; force_error, relative, on the same grid;
        position (n_positions, 3) [m]; load (n_positions, 3, rank and zeros) and the contact_*
        blocks with their hash tables: compliance [m/N]; softness (1,), added where access fades
        [m/N];
        space (n_modes, BLOCK), core (n_modes, m) and level (n_modes,), the modes of the cloud's
        blocks; block_start (n_parts, n_blocks + 1), those of each part: global modes that move
        beside the loads, each region, and each region's large deformation; shown (1,), the level
        that is shown; place (n_points,), of each point in the blocks; region (n_positions,) and
        regional_load (n_positions, 3, most), whose amplitudes begin at region_start
        (n_regions + 1,); rest (n_points, 6), the cloud without displacement [m]; tip_offset
        (n_tools,), of a pose above the lowest point of the tip [m]
    effects : Constants, None for each effect that was not chosen
    """

    arrays: Any
    effects: Constants

    def flat(self) -> dict[str, np.ndarray]:
        """All arrays by name, as "distance" or "friction.coefficients"."""
        out = dict(self.arrays._asdict())
        for name, chosen in self.effects._asdict().items():
            if chosen is not None:
                out |= {f"{name}.{key}": array for key, array in chosen._asdict().items()}
        return out

    @staticmethod
    def of(arrays: dict[str, np.ndarray]) -> Layout:
        """The inverse of :meth:`flat`."""
        chosen: dict[str, Any] = {}
        for name, kind in ARRAYS.items():
            own = [f"{name}.{key}" for key in kind._fields]
            chosen[name] = kind(*(arrays[key] for key in own)) if own[0] in arrays else None
        return Layout(
            ModelArrays(*(arrays[key] for key in ModelArrays._fields)), Constants(**chosen)
        )

    @property
    def nbytes(self) -> int:
        """Memory of all arrays [bytes]."""
        return int(sum(array.nbytes for array in self.flat().values()))


@dataclass(frozen=True)
class _Shape:
    """What a layout takes of the organ's shape and the tips, whatever the organ is made of."""

    carriers: TipCarriers
    reach: float  # longest distance between the two positions of a block [m]
    factor: ShapeFactor  # of each tip

    @classmethod
    def of(cls, vademecum: Vademecum, tips: Sequence[Tip]) -> _Shape:
        # Here, because the contact node needs none of it.
        from avatar_core.contact.kept_factors import factors_of

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
) -> Layout:
    """The constant arrays of a contact model; see :func:`avatar_core.contact.model.prepare`.

    detail : of the displacement; by default all modes at the surface
    """
    detail = detail or Detail(vademecum.n_modes)
    return next(lay_out_details(vademecum, tips, [detail], effects, period))


def lay_out_details(
    vademecum: Vademecum,
    tips: Sequence[Tip],
    details: Sequence[Detail],
    effects: Sequence[Effect] | None = None,
    period: float = PERIOD,
    shape: _Shape | None = None,
) -> Iterator[Layout]:
    """:func:`lay_out` for one detail after the other; they share what does not depend on it.

    Nothing is checked before the first is asked for.

    shape : of the organ and the tips, if it was found for another material
    """
    for detail in details:
        _check(vademecum, tips, detail)
    if effects is None:
        effects = default_effects(vademecum, len(tips))
    for effect in effects:
        effect.require(vademecum)
    if len(tips) > 1 and find(effects, SeveralTools) is None:
        raise SceneError(
            f"{len(tips)} tools without several_tools; add it to the effects, or name one tool"
        )
    leaning = find(effects, Tilt)
    if leaning is not None:
        leaning.require_flat(tips)
    vademecum, mass = adapted_vademecum(vademecum, effects)
    surface, contact = vademecum.surface, vademecum.contact_near
    contact_start, contact_slot = hash_rows(contact)
    load = vademecum.contact_load.reshape(surface.n_positions, 3, -1)
    padded, softness = _padded(load), float((load**2).sum(axis=(1, 2)).mean() / 3.0)
    field, offset = vademecum.tip_field, np.array([tip.offset for tip in tips])
    shape = shape or _Shape.of(vademecum, tips)
    response = make_tip_response(
        surface, field, shape.carriers, load, contact, vademecum.material.plane_strain_modulus
    )
    large = vademecum.large if find(effects, LargeDeformationEffect) is not None else None
    error = force_error_grid(vademecum.certificate, large, response.smoothing)
    tilt = tilt_arrays(leaning, tips, field) if leaning is not None else None
    law = tip_law_arrays(
        tips,
        vademecum.material,
        _local(vademecum, response.self_compliance),
        shape.factor,
        (vademecum.certificate or Certificate.unknown()).contact_sites.factor,
        large is not None and large.material == "neo-hookean",
    )
    clouds: dict[Cloud, CloudArrays] = {}
    for detail in details:
        if detail.cloud not in clouds:
            terms = large.terms if large else None
            clouds[detail.cloud] = cloud_arrays(
                vademecum, detail.cloud, terms, own_motion(vademecum, effects)
            )
        shown = rounded(clouds[detail.cloud])
        display = vademecum.display if detail.cloud == "surface" else None
        points = display.vertices if display else vademecum.mesh.vertices[np.sort(shown.points)]
        arrays = ModelArrays(
            distance=field.distance,
            access=field.access,
            origin=field.origin,
            spacing=field.spacing,
            row=response.row,
            carrier=response.carrier,
            carrier_weight=response.carrier_weight,
            self_compliance=response.self_compliance,
            force_error=error,
            position=np.ascontiguousarray(surface.centers),
            load=padded,
            contact_start=contact_start,
            contact_slot=contact_slot,
            contact_block=contact.block,
            softness=np.array([softness]),
            space=shown.space,
            core=shown.core,
            level=shown.level,
            block_start=shown.block_start,
            shown=np.array([detail.modes]),
            place=np.argsort(shown.points).astype(np.int32),
            region=vademecum.regional.region,
            region_start=shown.region_start,
            regional_load=shown.regional_load,
            rest=np.pad(points, ((0, 0), (0, 3))).astype(np.float32),
            tip_offset=offset,
        )
        nonlinear = (
            _nonlinear_arrays(vademecum, large, response, shown.large_start) if large else None
        )
        places = (surface.centers, surface.patch_radius)
        dent = dent_arrays(tips, points, *places) if law else None
        fine = None
        if display:
            fine = display_arrays(display, shown.points, vademecum.mesh.vertices, *places)
        yield Layout(
            arrays,
            selected_arrays(
                *(vademecum, effects, mass, nonlinear, shape.reach, surface.patch_radius, period),
                *(law, dent, tilt, fine),
            ),
        )


def lay_out_materials(
    materials: Iterable[Vademecum], tips: Sequence[Tip], detail: Detail
) -> Iterator[tuple[Vademecum, Layout]]:
    """:func:`lay_out` for one material of an organ after the other; they share its shape."""
    shape = None
    for vademecum in materials:
        shape = shape or _Shape.of(vademecum, tips)
        yield vademecum, next(lay_out_details(vademecum, tips, [detail], shape=shape))


def _local(vademecum: Vademecum, self_compliance: np.ndarray) -> np.ndarray:
    """E* and c on the grid of the tip field, shape (2, nx, ny, nz) float32.

    Over a tumour of contrast q that stores the fraction f of the energy under a tip, E* is that of
    the organ over 1 - f + f / q.
    """
    stiffness = vademecum.material.plane_strain_modulus
    radius = vademecum.surface.patch_radius
    field, local = vademecum.tip_field, np.zeros((2, *self_compliance.shape), np.float32)
    local[STIFFNESS] = stiffness
    if field.tumour is not None and vademecum.contrast is not None:
        local[STIFFNESS] /= 1.0 - field.tumour + field.tumour / vademecum.contrast
    local[TAKEN] = np.minimum(PATCH_ON_MESH / (local[STIFFNESS] * radius), self_compliance)
    return local


def _nonlinear_arrays(
    vademecum: Vademecum, large: LargeDeformation, response: TipResponse, start: np.ndarray
) -> LargeDeformationArrays:
    """Coefficients of large deformation on the grid, and its loads in the modes of the cloud."""
    values = np.vstack([large.depth, large.reach])
    grid = sampled_at_tip(vademecum.surface, vademecum.tip_field, response, values)
    return LargeDeformationArrays(grid, np.ascontiguousarray(large.terms.load), start)


def force_error_grid(
    certificate: Certificate | None, large: LargeDeformation | None, smoothing: np.ndarray
) -> np.ndarray:
    """The relative error of the force on the grid of the tip field; NaN if it is not known.

    smoothing : of :class:`avatar_core.contact.tip_response.TipResponse`, or values of it
    """
    nonlinear = 0.0
    if large is not None:
        nonlinear = large.certificate.contact_mean if large.certificate else float("nan")
    return (certificate or Certificate.unknown()).force_error.relative(smoothing, nonlinear)


def _padded(load: np.ndarray) -> np.ndarray:
    """The loads with zeros up to a multiple of ``LANES`` modes."""
    return np.pad(load, ((0, 0), (0, 0), (0, -load.shape[2] % LANES)))


def _check(vademecum: Vademecum, tips: Sequence[Tip], detail: Detail) -> None:
    if not 1 <= len(tips) <= kernels.MAX_TOOLS:
        raise ContactError(f"{len(tips)} tools; give 1 to {kernels.MAX_TOOLS} tips")
    modes, most = detail.modes, vademecum.n_modes
    if not 1 <= modes <= most:
        raise ContactError(f"{modes} modes asked for; the vademecum has 1 to {most}")
    if detail.cloud not in get_args(Cloud):
        raise ContactError(
            f"cloud '{detail.cloud}' is unknown; choose {', '.join(get_args(Cloud))}"
        )
