"""Errors of an accuracy curve: of a step's displacement and force at unseen contacts.

The compiled step itself presses a patch at drawn places, with its stencil and its smooth
compliance. It is compared with full finite elements of the same mesh: the force at the same depth,
the displacement under the same force.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from avatar_core.certify.unseen_contacts import HEIGHTS, draw_contacts
from avatar_core.contact.cloud import shown_vertices
from avatar_core.contact.layout import Shape, lay_out
from avatar_core.contact.model import (
    ContactData,
    ContactModel,
    Status,
    deform,
    estimate_error,
    solve,
)
from avatar_core.errors import ConvergenceError
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.accuracy import (
    AccuracyCurve,
    Cloud,
    CurvePoint,
    Detail,
    mode_levels,
    upper_quantile,
)
from avatar_core.vademecum.certificate import Certificate
from avatar_core.vademecum.force_error import ForceError

if TYPE_CHECKING:
    from avatar_core.fem.elasticity import Elasticity
    from avatar_core.vademecum.model import Vademecum

SHOWN: tuple[Cloud, ...] = ("surface", "volume")
PATCH_TIP = Tip("patch", HEIGHTS[1] + 2e-3)  # in contact wherever a tip is drawn


def details_of(n_modes: int) -> tuple[Detail, ...]:
    """Return the details at which a curve is measured: all combinations, and no cloud at all."""
    shown = tuple(Detail(modes, cloud) for cloud in SHOWN for modes in mode_levels(n_modes))
    return (*shown, Detail(n_modes, "off"))


@dataclass(frozen=True, eq=False)
class StepErrors:
    """Relative errors of a step at unseen contacts, a column for each.

    Attributes
    ----------
    shown : ndarray, shape (n_details - 1, n)
        Errors of the shown displacement under the step's force; no row for no cloud.
    force : ndarray, shape (n,)
        Errors of the force at the depth of the tip.
    smoothing : ndarray, shape (n,)
        Relative change of the compliance under a tip by smoothing.
    sizes : Sequence[int]
        Size of the data that show each detail [bytes].
    """

    shown: np.ndarray
    force: np.ndarray
    smoothing: np.ndarray
    sizes: Sequence[int]


def step_errors(
    vademecum: Vademecum, elasticity: Elasticity, n: int, seed: int, single: bool = False
) -> StepErrors:
    """Press a patch at ``n`` unseen places by the compiled step, against full finite elements.

    Parameters
    ----------
    n, seed : int
        Number of contacts, and the seed that draws them.
    single : bool
        Solve the finite elements in single precision.
    """
    contacts, levels = draw_contacts(vademecum, n, seed), mode_levels(vademecum.n_modes)
    vademecum = _bare(vademecum)
    details = [Detail(vademecum.n_modes, cloud) for cloud in SHOWN]
    shape = Shape.of(vademecum, (PATCH_TIP,))
    layouts = [lay_out(vademecum, (PATCH_TIP,), each, (), shape=shape) for each in details]
    loops = [ContactModel(layout).data() for layout in layouts]
    points = [shown_vertices(vademecum, cloud) for cloud in SHOWN]
    volume = [vademecum.mesh.vertex_volumes[p] for p in points]
    shown = np.empty((len(SHOWN) * len(levels), n))
    force, smoothing = np.empty((2, n))
    truth = contacts.solved(vademecum.surface, elasticity, single)
    for k, (tip, (compliance, field)) in enumerate(zip(contacts.tip, truth, strict=True)):
        row = iter(shown)
        for data, p, v in zip(loops, points, volume, strict=True):
            load = pressed(data, tip)
            for level in levels:
                data.show(level)
                deform(data.model, data)
                left = data.out.cloud[:, 3:] + load * field[p]
                next(row)[k] = np.sqrt(_square(left, v) / _square(load * field[p], v))
        force[k] = abs(load * compliance / -data.state.gap[0] - 1.0)
        estimate_error(data.model, data)
        smoothing[k] = data.out.force_error[0] / np.linalg.norm(data.out.force[0])
    sizes = [_size(layout, level) for layout in layouts for level in levels]
    return StepErrors(shown, force, smoothing, [*sizes, 0])


def _bare(vademecum: Vademecum) -> Vademecum:
    """Return the vademecum with the meshed surface, at small strain.

    The error that its steps estimate is the smoothing alone.
    """
    said = replace(Certificate.unknown(), force_error=ForceError(1.0, 0.0))
    return replace(vademecum, certificate=said, display=None, large=None)


def pressed(data: ContactData, tip: np.ndarray) -> float:
    """Return the force of a patch that appears at a place without a path [N]."""
    data.reset()
    status = solve(data.model, data, tip[None])
    if status != Status.OK:
        raise ConvergenceError(f"a patch {tip} m has no contact: {Status(status).name}")  # type: ignore[call-arg]
    return float(data.state.force[0])


def _square(field: np.ndarray, volume: np.ndarray) -> float:
    return float(volume @ (field**2).sum(axis=1))


def _size(arrays: Any, level: int) -> int:
    """Return the bytes of the modes up to a level, with their core and loads."""
    share = float(np.mean(arrays.level <= level)) if len(arrays.level) else 0.0
    modes = arrays.space.nbytes + arrays.core.nbytes + arrays.level.nbytes
    return round(share * modes) + arrays.regional_load.nbytes


def curve_of(
    vademecum: Vademecum, shown: np.ndarray, force: np.ndarray, sizes: Sequence[int]
) -> AccuracyCurve:
    """Return the curve of measured errors, not yet timed.

    shown : ndarray, shape (n_details - 1, n), relative errors of the displacement
    force : ndarray, shape (n,), relative errors of the normal force
    sizes : size of each detail [bytes]
    """
    details = details_of(vademecum.n_modes)
    force_error = upper_quantile(force)
    errors = [*(upper_quantile(row) for row in shown), float("nan")]
    points = (
        CurvePoint(detail, error, force_error, size)
        for detail, error, size in zip(details, errors, sizes, strict=True)
    )
    return AccuracyCurve(tuple(points), shown.shape[1])
