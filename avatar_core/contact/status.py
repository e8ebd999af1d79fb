"""Status codes of a tool, from the step or from the loop around it: the one list.

tests/ros/loop/test_statuses.py compares it with avatar_interfaces/msg/ContactState,
msg_docs/interfaces/contact_state.md and avatar_ros.loop.statuses.
"""

from __future__ import annotations

from enum import IntEnum

FAR_AWAY = 1e3  # coordinate of a tool without a pose [m]
# A tip that did not enter through the surface is barred until it is outside again. A contact that
# began at depth would release energy that no tool has put in.
OUTSIDE, ENTERED, BARRED = range(3)


class Status(IntEnum):
    """Number, name and ``meaning`` of each status.

    ``step`` returns OK, INVALID_POSE, NOT_CONVERGED, TOO_MANY_CONTACTS, OUT_OF_RANGE,
    EXTRAPOLATED or SLIPPED; the loop of the contact node gives the others.

    Examples
    --------
    >>> av.Status(av.step(model, model.data(), outside)) is av.Status.OK
    True
    """

    meaning: str

    def __new__(cls, number: int, meaning: str) -> Status:
        """Return a status with its number and meaning."""
        status = int.__new__(cls, number)
        status._value_, status.meaning = number, meaning
        return status

    OK = 0, "solved: in contact, or free (contacts empty)"
    NO_MODEL = 1, "no vademecum loaded yet"
    NO_POSE = 2, "no pose of the tool received yet"
    STALE_POSE = 3, "the last pose is too old to answer"
    INVALID_POSE = 4, "pose not finite, stamp 0, or not a rotation"
    NOT_CONVERGED = 5, "the contact solve reached its iteration limit"
    TOO_MANY_CONTACTS = 6, "more contacts than the model was prepared for"
    OUT_OF_RANGE = 7, "beyond the rim of the accessible surface, or too deep"
    UNKNOWN_FRAME = 8, "pose in another frame than tool_frame: refused, never used"
    EXTRAPOLATED = 9, "pushed or pulled beyond the range of the response: the force goes on"
    LEAP = 10, "the pose leapt farther than a tool can move"
    SEVERAL_PUBLISHERS = 11, "more than one node publishes poses of this tool"
    LOST_TOOL = 12, "no node publishes poses of this tool any more"
    ENGAGING = 13, "solved, but after a fault or at the start the force comes back softly"
    INACTIVE = 14, "the node is being deactivated"
    SLOW_POSES = 15, "sound poses come, but more slowly than pose_timeout allows"
    NO_OPERATING_STATE = 16, "the tool's device has not said that it is enabled and homed"
    NOT_ENABLED = 17, "the tool's device says that it is disabled, paused or in fault"
    NOT_HOMED = 18, "the tool's device says that it is not homed"
    SLIPPED = 19, "the jaw lost the tissue: open it, and close it again"


# With these, the step used the pose of the stamp; with INVALID_POSE none; with others FAR_AWAY.
PLACED = tuple(
    int(status)
    for status in (
        Status.OK,
        Status.NOT_CONVERGED,
        Status.TOO_MANY_CONTACTS,
        Status.OUT_OF_RANGE,
        Status.EXTRAPOLATED,
        Status.ENGAGING,
        Status.SLIPPED,
    )
)
