"""What the force on a tool may be, and where poses come from: the parameters below ``safety``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from avatar_core.contact.haptics.force_guard import DEVICES, ForceLimits
from avatar_core.contact.haptics.passivity import MAX_DELAY, Passivity, make_passivity
from avatar_ros.framework.parameters import Parameter, ParameterError

PASSIVITY = ("off", "observe", "control")
_DEVICE = "sigma"
_IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

SAFETY = (
    Parameter(
        "safety.device",
        _DEVICE,
        f"whose limits hold where the next two are 0: {', '.join(DEVICES)}",
    ),
    Parameter(
        "safety.max_force",
        0.0,
        "largest force sent [N]; 0: the device's",
        range=(0.0, 1000.0),
        read_only=False,
    ),
    Parameter(
        "safety.max_slew",
        0.0,
        "largest change of the force sent [N/s], but for the ramp after a fault; 0: the device's",
        range=(0.0, 1e6),
        read_only=False,
    ),
    Parameter(
        "safety.leap",
        0.02,
        "way between two poses, 2 ms apart or less, from which it is a fault [m]; in proportion "
        "for longer intervals",
        range=(0.001, 1.0),
        read_only=False,
    ),
    Parameter(
        "safety.passivity",
        "off",
        "energy that hold and delay make: off, observe (in diagnostics) or control (brake it)",
    ),
    Parameter(
        "safety.delay",
        1,
        "periods from a pose to the moment its force is felt, for passivity",
        range=(0, MAX_DELAY),
    ),
    Parameter(
        "safety.resolution",
        1e-5,
        "step of the device's readings, for passivity [m]",
        range=(0.0, 1e-3),
    ),
    Parameter(
        "tool_frame", "", "frame of the poses, and of the wrenches; empty: frame_id, the organ's"
    ),
    Parameter(
        "tool_transform",
        list(_IDENTITY),
        "where tool_frame lies in frame_id: x y z [m] and quaternion x y z w",
    ),
)


@dataclass(frozen=True)
class Safety:
    """Limits of the force, what makes a fault, and what watches the energy.

    leap : [m] in 2 ms; passivity : one of ``PASSIVITY``; delay : [periods]; resolution : [m]
    frame : of the poses, empty for the organ's; transform : of it in the organ's, x y z [m] and
        quaternion x y z w
    """

    limits: ForceLimits = DEVICES[_DEVICE]
    leap: float = 0.02
    passivity: str = "off"
    delay: int = 1
    resolution: float = 1e-5
    frame: str = ""
    transform: tuple[float, ...] = _IDENTITY

    def observer(self, n_tools: int, period: float) -> Passivity | None:
        """What keeps account of the energies; None where nothing does."""
        if self.passivity == "off":
            return None
        return make_passivity(n_tools, self.delay, self.resolution, period)


def chosen_safety(value: dict[str, Any]) -> Safety:
    """What the parameters come to.

    Raises
    ------
    ParameterError : naming the parameter and what it takes
    """
    device = DEVICES.get(value["safety.device"])
    if device is None:
        raise ParameterError(f"parameter safety.device: give one of {', '.join(DEVICES)}")
    if value["safety.passivity"] not in PASSIVITY:
        raise ParameterError(f"parameter safety.passivity: give one of {', '.join(PASSIVITY)}")
    limits = ForceLimits(
        value["safety.max_force"] or device.force, value["safety.max_slew"] or device.slew
    )
    return Safety(
        limits,
        value["safety.leap"],
        value["safety.passivity"],
        value["safety.delay"],
        value["safety.resolution"],
        value["tool_frame"],
        _transform(value["tool_transform"]),
    )


def _transform(numbers: Any) -> tuple[float, ...]:
    found = tuple(float(number) for number in numbers)
    square = sum(number * number for number in found[3:])
    if len(found) != 7 or not all(map(math.isfinite, found)) or not abs(square - 1.0) < 2e-3:
        raise ParameterError(
            "parameter tool_transform: give x y z in metres and a quaternion x y z w of length 1"
        )
    return found
