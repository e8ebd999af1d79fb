"""Contact between tool tips and an organ at 1 kHz: a model, its data, and the step.

    model = model_of(vademecum, tips)       # constant; seconds, may fail
    data = model.data()                     # state and results of one loop
    status = step(model, data, positions)   # 1 kHz; never fails: see data.out

A model can serve several loops at once, each with data of its own. The compiled code is in
:mod:`avatar_core.contact.step`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from hashlib import sha256
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from avatar_core.common.array_table import ArrayTable, TableType, flat, restart
from avatar_core.contact import step as kernels
from avatar_core.contact.data import DATA, RESUMED, at_rest, begin
from avatar_core.contact.effects import Effect
from avatar_core.contact.layout import MODEL, PERIOD, lay_out
from avatar_core.contact.status import BARRED
from avatar_core.contact.status import FAR_AWAY as FAR_AWAY
from avatar_core.contact.status import Status as Status
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.accuracy import Cloud, Detail

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


class _Compiled(NamedTuple):
    """Both halves of a step, and the error of its forces."""

    solve: Callable[..., int]
    deform: Callable[..., None]
    error: Callable[..., None]


@cache
def compiled_step() -> _Compiled:
    """Return the step compiled once for all models.

    Compilation takes most of a minute; the result is then cached on disk.
    """
    types = TableType(MODEL), TableType(DATA)
    return _Compiled(
        compiled_for(kernels.contact_solve, *types),
        compiled_for(kernels.contact_deform, *types),
        compiled_for(kernels.force_error, *types),
    )


def compiled_for(kernel: Any, *types: Any) -> Any:
    """Return a kernel compiled for numba types, called without numba's look-up of types."""
    kernel.compile(types)
    return kernel.get_overload(types)


_WITH_MEMORY = ("viscoelasticity", "inertia")  # effects of which a loop keeps a history


def _digest_of_memory(arrays: dict[str, np.ndarray]) -> bytes:
    """Return the digest of load modes, tips and the effects that keep a history."""
    digest = sha256()
    for name, array in arrays.items():
        if name in ("load", "tip_offset") or name.startswith(_WITH_MEMORY):
            digest.update(name.encode() + array.tobytes())
    return digest.digest()


class ContactModel:
    """The constant part of a contact simulation: an organ, its tools and effects.

    Attributes
    ----------
    arrays : tuple
        Constants, named by :data:`avatar_core.contact.layout.MODEL`. Nobody may change them.
    table : ndarray
        Where they lie, for compiled code.
    compiled : callable
        The step, the same for all models.
    memory : bytes
        Digest of what a load history belongs to: models with the same can go on with it.

    Examples
    --------
    >>> model = av.prepare(v, av.Scene(effects=()))
    >>> model.n_tools, model.data() is model.data()
    (1, False)
    """

    def __init__(self, arrays: Any) -> None:
        self.arrays, self.table, self.compiled = arrays, ArrayTable(arrays), compiled_step()
        self.memory = _digest_of_memory(flat(arrays))

    def data(self) -> ContactData:
        """The data of a loop, of an organ at rest without any contact. Not real-time safe."""
        return ContactData(self)

    @property
    def n_tools(self) -> int:
        """Number of tools."""
        return len(self.arrays.tip_offset)

    @property
    def n_modes(self) -> int:
        """Modes that the cloud can show; see :class:`avatar_core.vademecum.accuracy.Detail`."""
        return int(self.arrays.shown[0])

    @property
    def nbytes(self) -> int:
        """Memory of the arrays [bytes]."""
        return sum(array.nbytes for array in flat(self.arrays).values())


class ContactData:
    """State of one loop between the steps of a model, and the result of the last.

    Attributes
    ----------
    model : ContactModel
        Constants.
    state : tuple
        Arrays that the step keeps, named by :data:`avatar_core.contact.data.DATA`, and one more
        for each effect.
    out
        Results of the last step, named by :data:`avatar_core.contact.data.OUT`: forces, contacts,
        cloud.
    table : ndarray
        Where these arrays lie, for compiled code.
    turns : bool
        Whether it matters that a tool turns.

    Examples
    --------
    >>> data = av.prepare(v).data()
    >>> data.out.force.shape  # of one tool [N]
    (1, 3)
    """

    def __init__(self, model: ContactModel) -> None:
        self.model, self.state = model, at_rest(model.arrays)
        self.out, self.table = self.state.out, ArrayTable(self.state)
        self.turns = self.state.friction is not None or self.state.tilt is not None
        step(model, self, np.full((model.n_tools, 3), FAR_AWAY))  # the cloud at rest
        self.reset()

    @property
    def grasps(self) -> bool:
        """Whether jaws are simulated."""
        return self.state.grasp is not None

    def holds(self, tool: int) -> bool:
        """Whether the jaw of a tool holds tissue. Real-time safe."""
        return self.state.grasp is not None and bool(self.state.grasp.held[tool])

    @property
    def n_shown(self) -> int:
        """Modes that the cloud shows."""
        return int(self.state.shown[0])

    def show(self, modes: int) -> None:
        """Show the displacement with fewer modes, or with all again, from the next step on.

        Real-time safe. The force does not change: the contact compliance keeps all modes.
        """
        self.state.shown[0] = min(max(modes, 0), self.model.n_modes)

    def resume(self, before: ContactData) -> None:
        """Take over the contacts of another model of the same organ and tools.

        Real-time safe: copies arrays of a few numbers per tool.
        """
        mine, theirs = self.state, before.state
        for name in RESUMED:
            getattr(mine, name)[:] = getattr(theirs, name)
        if mine.friction is not None and theirs.friction is not None:
            for name in ("anchor", "motion", "push"):
                getattr(mine.friction, name)[:] = getattr(theirs.friction, name)
        if theirs.grasp is not None:
            for tool in range(self.model.n_tools):
                self._resume_jaw(before, tool)
        if mine.respiration is not None and theirs.respiration is not None:
            mine.respiration.clock[:] = theirs.respiration.clock
        if self.model.memory == before.model.memory:
            for name in _WITH_MEMORY:
                if getattr(mine, name) is not None:
                    for own, other in zip(getattr(mine, name), getattr(theirs, name), strict=True):
                        own[:] = other

    def _resume_jaw(self, before: ContactData, tool: int) -> None:
        """Take over what a jaw holds; without a jaw here, as if it had been opened."""
        mine, theirs = self.state, before.state
        if mine.grasp is not None and self.model.arrays.grasp.radius[tool] > 0.0:
            for name in ("held", "begun", "shut", "slipped", "place", "start", "now"):
                getattr(mine.grasp, name)[tool] = getattr(theirs.grasp, name)[tool]
            mine.grasp.fresh[tool] = mine.grasp.held[tool]
        elif before.holds(tool):
            mine.passage[tool], mine.active[tool], mine.force[tool] = BARRED, False, 0.0
            if mine.friction is not None:
                mine.friction.push[tool] = 0.0

    def note_shut(self, jaws: np.ndarray) -> None:
        """Note which jaws, shape (n_tools,), are closed already: they hold nothing new.

        Real-time safe.
        """
        if self.state.grasp is not None:
            self.state.grasp.shut[:] = jaws

    def reset(self) -> None:
        """Return to the organ at rest, without contacts or history. Not real-time safe."""
        restart(self.state, kept=("out", "shown"))
        self.out.force_error[:] = np.nan
        begin(self.model.arrays, self.state)


def model_of(
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
    tips : Sequence[Tip]
        Tip of each tool.
    modes : int or None
        Modes of the *displacement*, as in :class:`avatar_core.vademecum.accuracy.Detail`; None for
        all. The force stays exact with fewer modes, since the contact compliance keeps all of its
        own.
    cloud : Cloud
        "surface" or "volume" vertices, or "off".
    effects : Sequence[Effect] or None
        Effects to simulate; by default those that the vademecum and the tools require.
    period : float
        Period of the steps [s], for effects that depend on time.

    Raises
    ------
    ContactError, SceneError
        For modes or clouds out of range; for effects that the vademecum does not support.
    """
    detail = Detail(vademecum.n_modes if modes is None else modes, cloud)
    return ContactModel(lay_out(vademecum, tips, detail, effects, period))


def step(
    model: ContactModel,
    data: ContactData,
    tips: np.ndarray,
    orientations: np.ndarray | None = None,
    jaws: np.ndarray | None = None,
) -> int:
    """Advance one period.

    Real-time safe: allocates no arrays, takes no locks, never raises or logs.

    Parameters
    ----------
    tips : ndarray, shape (n_tools, 3), sphere centres [m]
    orientations : ndarray, shape (n_tools, 4), unit quaternions x y z w of the tools' frames in the
        organ's, zero for one that is not known; None if no tool turns. For friction and tilt.
    jaws : ndarray of bool, shape (n_tools,), which are closed; None: as before. For grasp.

    Returns
    -------
    int
        The worst :class:`Status` of the tools; ``out.status`` has each. INVALID_POSE: not
        finite; OUT_OF_RANGE: off the accessible surface, too deep, or not entered through the
        surface; these tools have no force or a fading one. NOT_CONVERGED: the contact forces are
        those of the last iteration. EXTRAPOLATED: deeper than the computed large deformation, or
        pulled too far. SLIPPED: the jaw lost what it held.

    Examples
    --------
    >>> model = av.prepare(v, av.Scene(effects=()))
    >>> data = model.data()
    >>> for depth in np.linspace(-5e-3, 2e-3, 50):  # a sphere of 5 mm comes down
    ...     status = av.step(model, data, point + (5e-3 - depth) * normal)
    >>> status == av.Status.OK, np.linalg.norm(data.out.force[0]) > 0.1  # [N]
    (True, True)
    """
    status = solve(model, data, tips, orientations, jaws)
    deform(model, data)
    return status


def solve(
    model: ContactModel,
    data: ContactData,
    tips: np.ndarray,
    orientations: np.ndarray | None = None,
    jaws: np.ndarray | None = None,
) -> int:
    """Compute forces and contacts: the first half of :func:`step`. Real-time safe."""
    state = data.state
    state.tip[:] = tips
    if data.turns:
        state.orientation[:] = 0.0 if orientations is None else orientations
    if jaws is not None:
        state.jaw[:] = jaws
    return model.compiled.solve(model.table, data.table)


def deform(model: ContactModel, data: ContactData) -> None:
    """Compute the cloud: the second half of :func:`step`. Real-time safe."""
    model.compiled.deform(model.table, data.table)


def estimate_error(model: ContactModel, data: ContactData) -> None:
    """Write the expected error of the last step's forces to ``out.force_error`` [N].

    One contact in ten exceeds it; see :mod:`avatar_core.vademecum.force_error`. It is NaN where the
    vademecum was not measured. Real-time safe, like :func:`step`; separate, so that it can follow
    the sending of the forces.

    Examples
    --------
    >>> model = av.prepare(v, av.Scene(effects=()))
    >>> data = model.data()
    >>> bool(np.isnan(data.out.force_error[0]))
    True
    >>> status = av.step(model, data, point + 3e-3 * normal)  # a sphere of 5 mm, 2 mm deep
    >>> av.estimate_error(model, data)
    >>> bool(0.0 < data.out.force_error[0] < np.linalg.norm(data.out.force[0]))
    True
    """
    model.compiled.error(model.table, data.table)
