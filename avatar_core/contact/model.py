"""Contact between tool tips and an organ at 1 kHz: offline ``prepare``, online ``step``.

``prepare`` allocates, compiles and may fail; ``step`` does none of it and returns a status.
The compiled code is in :mod:`avatar_core.contact.kernels`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np

from avatar_core.common.array_table import ArrayTable
from avatar_core.contact import kernels, locate
from avatar_core.contact.cloud import BLOCK
from avatar_core.contact.effects.base import Effect
from avatar_core.contact.effects.selection import Selection, allocate, every_effect
from avatar_core.contact.kernels import Out, State
from avatar_core.contact.layout import PERIOD, Layout, lay_out
from avatar_core.contact.status import FAR_AWAY as FAR_AWAY
from avatar_core.contact.status import Status as Status
from avatar_core.contact.tip_response import MAX_STENCIL
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.accuracy import Cloud, Detail

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


class Compiled(NamedTuple):
    """Both halves of a step, and the error of its forces with its arguments."""

    solve: Callable[..., int]
    deform: Callable[..., None]
    error: Callable[..., None]


class Tables(NamedTuple):
    """The arguments of a step but the tips."""

    arrays: ArrayTable
    state: ArrayTable
    out: ArrayTable
    effects: ArrayTable


@dataclass(frozen=True)
class ContactModel:
    """Everything a step reads and writes.

    layout : Layout, constant
    state : State, forces kept for the next period, and scratch
    effects : Selection, state and scratch of the chosen effects, None for the others
    out : Out
        force, torque (n_tools, 3) [N, N m], of the organ on each tool about its pose: of
        friction, and of a punch that leans; status (n_tools,), of each;
        cloud (n_points, 6) float32, deformed position and displacement [m];
        force_error (n_tools,), that one contact in ten exceeds [N], by :func:`estimate_error`;
        n_contacts (1,), then contact_tool, contact_position, contact_normal (organ to tool),
        contact_force (on the tool), contact_penetration of the active contacts
    tips : ndarray, shape (n_tools, 3), sphere centres of the present step [m]
    tables : where all these arrays lie, for compiled code
    compiled : Compiled
    """

    layout: Layout
    state: Any
    effects: Selection
    out: Any
    tips: np.ndarray
    tables: Tables
    compiled: Compiled

    @property
    def arrays(self) -> Any:
        """Constant arrays of the organ and its tools."""
        return self.layout.arrays

    @property
    def n_tools(self) -> int:
        """Number of tools."""
        return len(self.arrays.tip_offset)

    @property
    def nbytes(self) -> int:
        """Memory of the constant arrays [bytes]."""
        return self.layout.nbytes

    @property
    def axes(self) -> np.ndarray | None:
        """Unit vectors from tip to shaft, shape (n_tools, 3), to be set before a step.

        None without tilt; zero, as at first, for a tool along the surface's normal.
        """
        return None if self._tilt is None else np.asarray(self._tilt.axis)

    @property
    def shaft(self) -> np.ndarray | None:
        """The same in the frame of the tools' poses, shape (3,); None without tilt."""
        return None if self._tilt is None else np.asarray(self._tilt.shaft)

    @property
    def _tilt(self) -> Any:
        return None if self.effects.tip_law is None else self.effects.tip_law.tilt

    @property
    def n_modes(self) -> int:
        """Modes that the cloud can show; see :class:`avatar_core.vademecum.accuracy.Detail`."""
        return int(self.arrays.shown[0])

    @property
    def n_shown(self) -> int:
        """Modes that the cloud shows."""
        return int(self.state.shown[0])

    def show(self, modes: int) -> None:
        """Show the displacement with fewer modes, or with all again, from the next step on.

        Real-time safe. The force does not change: the contact compliance keeps all modes.
        """
        self.state.shown[0] = min(max(modes, 0), self.n_modes)

    def resume(self, before: ContactModel) -> None:
        """Take over the contacts of another model of the same organ and tools.

        Real-time safe: copies arrays of a few numbers per tool.
        """
        for name in ("passage", "seen", "active", "force"):
            getattr(self.state, name)[:] = getattr(before.state, name)
        mine, theirs = self.effects, before.effects
        if mine.friction is not None and theirs.friction is not None:
            for name in ("anchor", "motion", "push"):
                getattr(mine.friction, name)[:] = getattr(theirs.friction, name)
        if mine.respiration is not None and theirs.respiration is not None:
            mine.respiration.clock[:] = theirs.respiration.clock

    def reset(self) -> None:
        """Return to the organ at rest, without contacts or history. Not real-time safe."""
        self.state.passage[:] = locate.OUTSIDE
        self.state.force[:] = 0.0
        fresh = _effects(self.layout)
        for mine, new in zip(self.effects, fresh, strict=True):
            _restore(mine, new)


def _restore(arrays: Any, clean: Any) -> None:
    """Set arrays, or tuples of them, to those of the same kind that nothing has touched."""
    if isinstance(arrays, np.ndarray):
        if arrays is not clean:  # constants are the same in both
            arrays[...] = clean
        return
    for one, other in zip(arrays or (), clean or (), strict=True):
        _restore(one, other)


def prepare(
    vademecum: Vademecum,
    tips: Sequence[Tip] = (Tip(),),
    modes: int | None = None,
    cloud: Cloud = "surface",
    effects: Sequence[Effect] | None = None,
    period: float = PERIOD,
) -> ContactModel:
    """Lay out a vademecum for the step. Not real-time safe: the first time compiles the step.

    Parameters
    ----------
    vademecum : Vademecum
    tips : the tip of each tool
    modes : of the *displacement*, as in :class:`avatar_core.vademecum.accuracy.Detail`; None for
        all. Fewer modes leave the force exact, since the contact compliance keeps all of its own.
    cloud : "surface" or "volume" vertices, or "off"
    effects : to simulate; by default those that the vademecum and the tools require
    period : of the steps [s], for effects that depend on time

    Raises
    ------
    ContactError, SceneError
        For modes or clouds out of range; for effects that the vademecum cannot serve.
    """
    detail = Detail(vademecum.n_modes if modes is None else modes, cloud)
    return make_model(lay_out(vademecum, tips, detail, effects, period))


def make_model(layout: Layout) -> ContactModel:
    """Allocate state and outputs, and run the step once. Not real-time safe."""
    arrays, state, out, effects = layout.arrays, _state(layout), _out(layout), _effects(layout)
    far_away = np.full((len(arrays.tip_offset), 3), FAR_AWAY)
    tables = Tables(
        ArrayTable(arrays), ArrayTable(state), ArrayTable(out), ArrayTable(effects, every_effect())
    )
    around = (tables.arrays, tables.state, tables.out, far_away, tables.effects)
    error = partial(compiled_for(kernels.force_error, *around), *around)
    first = compiled_for(kernels.contact_solve, *around)
    compiled = Compiled(first, compiled_for(kernels.contact_deform, *tables), error)
    model = ContactModel(layout, state, effects, out, far_away, tables, compiled)
    model.reset()
    return model


def _state(layout: Layout) -> State:
    """Without any contact."""
    arrays, single = layout.arrays, np.float32
    n_tools, n_modes = len(arrays.tip_offset), arrays.load.shape[2]
    n_regions = len(arrays.region_start) - 1
    return State(
        passage=np.zeros(n_tools, np.int64),
        seen=np.zeros((n_tools, 3)),
        force=np.zeros(n_tools),
        active=np.zeros(n_tools, np.bool_),
        gap=np.zeros(n_tools),
        slope=np.zeros((n_tools, 3)),
        steepness=np.ones(n_tools),
        normal=np.zeros((n_tools, 3)),
        access=np.zeros(n_tools),
        access_slope=np.zeros((n_tools, 3)),
        point=np.zeros((n_tools, 3)),
        local=np.full(len(arrays.position), -1, np.int64),
        nodes=np.zeros((n_tools, MAX_STENCIL), np.int64),
        n_nodes=np.zeros(n_tools, np.int64),
        weight=np.zeros((n_tools, MAX_STENCIL, 4)),
        mode=np.zeros((n_tools, n_modes), single),
        column=np.zeros((n_tools, MAX_STENCIL, 3), single),
        self_compliance=np.ones(n_tools),
        self_slope=np.zeros((n_tools, 3)),
        blurred=np.zeros(n_tools),
        compliance=np.zeros((n_tools, n_tools)),
        shown=arrays.shown.astype(np.int64),
        amplitude=np.zeros(_n_amplitudes(layout), single),
        touched=np.zeros(n_regions, np.int64),
        n_touched=np.zeros(1, np.int64),
        is_touched=np.zeros(n_regions, np.bool_),
        region_weight=np.zeros(n_regions),
        field=np.zeros((arrays.block_start.shape[1] - 1) * BLOCK, single),
    )


def _out(layout: Layout) -> Out:
    """Without any force."""
    n_tools = len(layout.arrays.tip_offset)
    return Out(
        force=np.zeros((n_tools, 3)),
        torque=np.zeros((n_tools, 3)),
        force_error=np.zeros(n_tools),
        status=np.zeros(n_tools, np.int64),
        cloud=np.zeros((len(layout.arrays.rest), 6), np.float32),
        n_contacts=np.zeros(1, np.int64),
        contact_tool=np.zeros(n_tools, np.int64),
        contact_position=np.zeros((n_tools, 3)),
        contact_normal=np.zeros((n_tools, 3)),
        contact_force=np.zeros((n_tools, 3)),
        contact_penetration=np.zeros(n_tools),
    )


def _n_amplitudes(layout: Layout) -> int:
    """Of global modes that stand apart, of all regions, and of large deformation."""
    large = layout.effects.large_deformation
    return int((layout.arrays.region_start if large is None else large.start)[-1])


def _effects(layout: Layout) -> Selection:
    n_positions, _, n_modes = layout.arrays.load.shape
    return allocate(layout.effects, len(layout.arrays.tip_offset), n_modes, n_positions)


def compiled_for(kernel: Any, *arguments: Any) -> Any:
    """A kernel compiled for the types of these arguments, after one run with them.

    Called without numba's look-up of these types.
    """
    kernel(*arguments)
    return kernel.get_overload(tuple(numba.typeof(argument) for argument in arguments))


def step(model: ContactModel, tips: np.ndarray) -> int:
    """Advance one period.

    Real-time safe: allocates no arrays, takes no locks, never raises or logs.

    Parameters
    ----------
    model : ContactModel, whose ``out`` is filled
    tips : ndarray, shape (n_tools, 3), sphere centres [m]

    Returns
    -------
    int
        The worst :class:`Status` of the tools; ``out.status`` has each. INVALID_POSE: not
        finite; OUT_OF_RANGE: off the accessible surface, too deep, or not entered through the
        surface; these tools have no force or a fading one. NOT_CONVERGED: the contact forces are
        those of the last iteration. EXTRAPOLATED: deeper than the computed large deformation.
    """
    status = solve(model, tips)
    deform(model)
    return status


def solve(model: ContactModel, tips: np.ndarray) -> int:
    """The first half of :func:`step`: forces and contacts. Real-time safe, as :func:`step`."""
    model.tips[:] = tips
    arrays, state, out, effects = model.tables
    return model.compiled.solve(arrays, state, out, model.tips, effects)


def deform(model: ContactModel) -> None:
    """The second half of :func:`step`: the cloud. Real-time safe, as :func:`step`."""
    model.compiled.deform(*model.tables)


def estimate_error(model: ContactModel) -> None:
    """Expected error of the forces of the last step, into ``out.force_error`` [N].

    Exceeded by one contact in ten; see :mod:`avatar_core.vademecum.force_error`. NaN where the
    vademecum was not measured. Real-time safe, as :func:`step`; separate, so that it can follow
    the sending of the forces.
    """
    model.compiled.error()
