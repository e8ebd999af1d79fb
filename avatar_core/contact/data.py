"""State of a loop between the steps of a contact model, and their scratch: the kind DATA."""

from __future__ import annotations

from typing import Any

import numpy as np

from avatar_core.common.array_table import allocate, array, kind, sizes_of
from avatar_core.contact.effects import EFFECTS
from avatar_core.contact.layout import MODEL
from avatar_core.contact.organ_response import MAX_STENCIL
from avatar_core.contact.superposition import SUPERPOSITION
from avatar_core.reduction.block_field import BLOCK
from avatar_core.tips.dent import DENT_STATE
from avatar_core.tips.law import LAW_STATE

# The result of a step, of T tools; of the n_contacts active ones, the contact_* hold the first.
OUT = kind(
    "Out",
    force=array("T 3"),  # force of the organ on each tool [N],
    torque=array("T 3"),  # torque about its pose [N m]: of friction, and of a punch that leans
    # error that one contact in ten exceeds [N], by `estimate_error`; NaN before
    force_error=array("T", start=float("nan")),
    status=array("T", np.int64),  # status of each tool
    cloud=array("V 6", np.float32),  # deformed position and displacement [m]
    n_contacts=array("1", np.int64),
    contact_tool=array("T", np.int64),
    contact_position=array("T 3"),
    contact_normal=array("T 3"),  # from the organ to the tool
    contact_force=array("T 3"),  # on the tool
    contact_penetration=array("T"),
)

_S = str(MAX_STENCIL)
DATA = kind(
    "Data",
    # inputs of a step
    tip=array("T 3"),  # sphere centres [m]
    orientation=array("T 4"),  # quaternions of the tools, x y z w; zero if unknown
    jaw=array("T", np.bool_),  # whether the jaw of a tool is closed
    shown=array("1", np.int64),  # level of the modes that are shown
    # state between steps
    passage=array("T", np.int64),  # whether the tip entered through the surface
    seen=array("T 3"),  # last valid position of the tip in contact [m]
    force=array("T"),  # lambda [N]
    active=array("T", np.bool_),  # closer than its radius to a surface that it may touch
    before=array("T 4"),  # orientation in the last period
    # scratch
    spin=array("T 3"),  # rotation of the tool in this period [rad]
    axis=array("T 3"),  # from tip to shaft; 0 for a tool along the surface's normal
    gap=array("T"),  # phi - r [m]
    slope=array("T 3"),  # grad phi
    steepness=array("T", start=1.0),  # its length
    normal=array("T 3"),  # n
    access=array("T"),  # chi
    access_slope=array("T 3"),
    point=array("T 3"),  # s [m]
    local=array("P", np.int64, -1),  # scratch of gather, all -1
    nodes=array(f"T {_S}", np.int64),  # load positions that carry the tip
    n_nodes=array("T", np.int64),
    weight=array(f"T {_S} 4"),  # w and its gradient
    mode=array("T K", np.float32),  # Y^T f
    column=array(f"T {_S} 3", np.float32),  # near displacement at the nodes, unit normal force
    self_compliance=array("T", start=1.0),  # gamma
    self_slope=array("T 3"),  # grad gamma
    blurred=array("T"),  # gamma - f . C f [m/N]
    compliance=array("T T"),
    amplitude=array(
        "amplitudes", np.float32
    ),  # amplitudes of separate global modes, then of regions
    touched=array("regions", np.int64),  # the regions whose modes move the cloud,
    n_touched=array("1", np.int64),  # their number,
    is_touched=array("regions", np.bool_),  # and whether a region is one
    region_weight=array("regions"),
    field=array("field", np.float32),  # displacement of the cloud, three components a point
    out=OUT,
    superposition=SUPERPOSITION,
    law=LAW_STATE,
    dent=DENT_STATE,
    **{name: effect.State for name, effect in EFFECTS.items() if effect.State is not None},
)
RESUMED = ("passage", "seen", "active", "force", "before", "jaw")  # by another model of an organ


def at_rest(model: Any) -> Any:
    """Return the arrays of an untouched organ at rest, a tuple of DATA.

    model : a tuple of MODEL
    """
    sizes = sizes_of(model) | {"S": MAX_STENCIL}
    sizes["3T"], sizes["regions"] = 3 * sizes["T"], sizes["r"] - 1
    sizes["field"] = BLOCK * (sizes["blocks"] - 1)
    large = model.large_deformation
    sizes["amplitudes"] = int((model.region_start if large is None else large.start)[-1])
    states: dict[str, Any] = {"out": allocate(OUT, sizes)}
    if model.superposed[0]:
        states["superposition"] = allocate(SUPERPOSITION, sizes)
    for name in DATA.members.keys() & MODEL.members.keys():
        constants = getattr(model, name)
        if constants is not None and not isinstance(constants, np.ndarray):
            states[name] = allocate(DATA.members[name], sizes | sizes_of(constants))
    data = allocate(DATA, sizes, **states)
    data.shown[:] = model.shown
    begin(model, data)
    return data


def begin(model: Any, data: Any) -> None:
    """Let each effect set the arrays that do not start at their first value."""
    for name, effect in EFFECTS.items():
        if effect.State is not None and getattr(data, name) is not None:
            effect.begin(model, getattr(data, name))
