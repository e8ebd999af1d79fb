"""Cause and remedy of each status of ContactState, for operators."""

from __future__ import annotations

from avatar_core.contact.status import Status

# every status in which a tool's force is missing or doubtful
EXPLANATIONS: dict[int, tuple[str, str]] = {
    Status.NO_MODEL: ("no vademecum is loaded", "load one"),
    Status.NO_POSE: ("no pose of the tool has arrived yet", "start its driver"),
    Status.STALE_POSE: (
        "the tool's poses have stopped",
        "check its driver, the network and the load of the machine",
    ),
    Status.SLOW_POSES: (
        "the tool's poses come more slowly than pose_timeout allows",
        "send them faster, or set pose_timeout to twice the time between them",
    ),
    Status.INVALID_POSE: (
        "a pose of the tool is not finite, has stamp 0, or is not a rotation",
        "check its driver",
    ),
    Status.NOT_CONVERGED: (
        "the contact solve reached its iteration limit",
        "lift the tool a little",
    ),
    Status.OUT_OF_RANGE: (
        "the tool is off the accessible surface, too deep, or was lost inside the organ",
        "lift it off the organ",
    ),
    Status.UNKNOWN_FRAME: (
        "the tool's poses are in another frame",
        "set tool_frame and tool_transform of the contact node, or publish in the organ's frame",
    ),
    Status.EXTRAPOLATED: (
        "the tool presses or pulls beyond the computed range; the force is extrapolated",
        "press less deeply, or pull less far",
    ),
    Status.SLIPPED: ("the jaw lost the tissue", "open it, and close it again"),
    Status.LEAP: ("the tool's pose jumped", "check its driver, or raise safety.leap"),
    Status.SEVERAL_PUBLISHERS: ("several nodes send poses of the tool", "stop all but one"),
    Status.LOST_TOOL: ("no node sends the tool's poses any longer", "start its driver again"),
    Status.NO_OPERATING_STATE: (
        "the tool's device has not reported its state",
        "start its driver, remap NAME/operating_state to it, or set tool_operating_state to false",
    ),
    Status.NOT_ENABLED: (
        "the tool's device is not enabled",
        "enable it, or resume it if it was paused, at its console or by NAME/state_command",
    ),
    Status.NOT_HOMED: (
        "the tool's device is not homed",
        "home it at its console, by hand or by NAME/state_command, following its manual",
    ),
    Status.INACTIVE: ("the contact node is being stopped", "activate it again"),
}


def explanation(status: int) -> str:
    """Return cause and remedy in one line; empty for a status that needs none."""
    return "; ".join(EXPLANATIONS.get(status, ()))
