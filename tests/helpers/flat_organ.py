"""An organ that is a plane or a ball: one load position, the same response everywhere.

phi = z, or |x| - R. The patch has the compliance C = far + near in every direction, so that
contact, friction and relaxation have closed forms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from avatar_core.contact.cloud_kernels import BLOCK
from avatar_core.contact.effects import EFFECTS, Effect, LargeDeformation
from avatar_core.contact.effects.base import Ground
from avatar_core.contact.layout import LANES, MODEL
from avatar_core.contact.model import ContactData
from avatar_core.fem.elasticity import Material
from avatar_core.fem.patch_on_plane import PATCH
from avatar_core.geometry.tip import Tip
from avatar_core.reduction.near_field import LocalBlocks, hash_rows
from avatar_core.tips.dent import dent_arrays
from avatar_core.tips.law import law_arrays
from avatar_core.tips.profile import STIFFNESS, TAKEN
from avatar_core.vademecum.tip_field import TipField
from tests.helpers.contact import data_of, step

FAR, NEAR = 3e-4, 1e-4  # [m/N]
COMPLIANCE = FAR + NEAR
RADIUS = 5e-3
PATCH_TIP = Tip("patch", RADIUS)
MATERIAL = Material(0.17e6, 0.48)
E_STAR = MATERIAL.young_modulus / (1.0 - MATERIAL.poisson_ratio**2)  # [Pa]
PATCH_RADIUS = 12e-3
BALL = 40e-3  # radius of the ball [m]
ORIGIN, UP = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])


def flat_organ(
    effects: Sequence[Effect] = (),
    period: float = 1e-3,
    compliance: float = COMPLIANCE,
    tip: Tip = PATCH_TIP,
    points: np.ndarray = ORIGIN,
    neo_hookean: float | None = None,
    is_ball: bool = False,
) -> ContactData:
    """Return the contact model of the flat organ with one tool.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        Points whose displacement is shown; the patch displaces none of them [m].
    neo_hookean : float, optional
        Poisson's ratio of an organ with large strain, whose patches respond linearly.
    is_ball : bool
        Whether the organ is the ball.
    """
    spacing, single, shape = 3e-3, np.float32, (41, 41, 41 if is_ball else 21)
    origin = -0.5 * spacing * (np.array(shape) - 1)
    axes = [o + spacing * np.arange(n) for o, n in zip(origin, shape, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"))
    distance = np.linalg.norm(grid, axis=0) - BALL if is_ball else grid[2]
    far, near = compliance * FAR / COMPLIANCE, compliance * NEAR / COMPLIANCE
    # weights are sums of splines: a row for every grid point, all carried by the one position
    load = np.zeros((1, 3, LANES), single)
    load[0, :, :3] = np.sqrt(far) * np.eye(3)
    blocks = LocalBlocks(
        np.array([0, 1]), np.zeros(1, np.int32), (near * np.eye(3, dtype=single))[None]
    )
    start, slot = hash_rows(blocks)
    gamma = float((load[0, 2] ** 2).sum()) + float(single(near))
    local = np.zeros((2, *shape), single)
    local[STIFFNESS], local[TAKEN] = E_STAR, PATCH / (E_STAR * PATCH_RADIUS)
    soft = replace(MATERIAL, poisson_ratio=neo_hookean or MATERIAL.poisson_ratio)
    law = law_arrays((tip,), soft, local, neo_hookean=neo_hookean is not None)
    field = TipField(distance.astype(single), np.ones(shape, single), origin, np.array([spacing]))
    constants: dict[str, Any] = {
        effect.name: effect.lay_out(_ground(field, tip, period)) for effect in effects
    }
    if neo_hookean is not None:
        constants["large_deformation"] = LargeDeformation.Constants(
            np.zeros((6, *shape), single), np.zeros((1, 4, 0), single), np.zeros(2, np.int64)
        )
    arrays = MODEL(
        distance=distance.astype(single),
        access=np.ones(shape, single),
        origin=origin,
        spacing=np.array([spacing]),
        row=np.zeros(shape, np.int32),
        carrier=np.zeros((1, 3), np.int32),
        carrier_weight=np.array([[1.0, 0.0, 0.0]], single),
        self_compliance=np.full(shape, gamma, single),
        force_error=np.zeros(shape, single),
        position=np.zeros((1, 3)),
        load=load,
        contact_start=start,
        contact_slot=slot,
        contact_block=blocks.block,
        softness=np.ones(1),
        space=np.zeros((0, BLOCK), np.int16),
        core=np.zeros((0, 1), single),
        level=np.zeros(0, np.int32),
        block_start=np.zeros((3, 1 - (-3 * len(points) // BLOCK)), np.int64),
        shown=np.array([1]),
        place=np.arange(len(points), dtype=np.int32),
        region=np.zeros(1, np.int32),
        region_start=np.zeros(2, np.int64),
        regional_load=np.zeros((1, 3, 0), single),
        rest=np.pad(points, ((0, 0), (0, 3))).astype(single),
        tip_offset=np.array([tip.offset]),
        superposed=np.array([any(effect.superposed for effect in effects)]),
        moving=np.array([any(effect.moving for effect in effects)]),
        law=law,
        dent=dent_arrays((tip,), points, np.zeros((1, 3)), PATCH_RADIUS) if law else None,
        display=None,
        **dict.fromkeys(EFFECTS.keys() & MODEL.members.keys()) | constants,
    )
    return data_of(arrays)


def _ground(field: TipField, tip: Tip, period: float) -> Ground:
    """Return the part of the organ that effects read."""
    surface = SimpleNamespace(patch_radius=PATCH_RADIUS)
    organ: Any = SimpleNamespace(surface=surface, tip_field=field)
    nothing: Any = None
    return Ground(organ, (tip,), (), nothing, LANES, 0.1, nothing, period)


def at_depth(depth: float, x: float = 0.0, y: float = 0.0, offset: float = RADIUS) -> np.ndarray:
    """Return the centre of a tip at a depth in the flat organ at rest, shape (1, 3)."""
    return np.array([[x, y, offset - depth]])


def force_at_depth(data: ContactData, depth: float, x: float = 0.0) -> float:
    """Step with the tip at this depth and return the normal force [N]."""
    step(data, at_depth(depth, x, offset=float(data.model.arrays.tip_offset[0])))
    return float(data.out.force[0, 2])
