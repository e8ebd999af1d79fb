"""The jaw of a tool, open or closed, as its driver publishes it on ``NAME/jaw/measured_js``.

CRTK gives the jaw as the first joint of a sensor_msgs/JointState, 0 where its plates meet. It is
closed below one position and open again above another, so that noise does not release tissue.
"""

from __future__ import annotations

import math
import struct
from typing import Any

from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from avatar_ros.framework import qos
from avatar_ros.framework.parameters import Parameter, ParameterError
from avatar_ros.framework.ports import PolledSubscriptions, Ports

JAW = (
    Parameter(
        "jaw.closed",
        0.1,
        "position of a jaw below which it is closed, in the unit of its driver (CRTK: rad)",
        range=(-1e3, 1e3),
        read_only=False,
    ),
    Parameter(
        "jaw.open",
        0.2,
        "position of a jaw above which it is open again; not below jaw.closed",
        range=(-1e3, 1e3),
        read_only=False,
    ),
)
_LONGEST = 4096  # longest message that is read [bytes]
_MOST_NAMES = 64  # most joint names that are skipped


def chosen_jaw(value: dict[str, Any]) -> tuple[float, float]:
    """Return the positions below which a jaw is closed, and above which it is open.

    Raises
    ------
    ParameterError
        If the second is the smaller one.
    """
    closed, opened = value["jaw.closed"], value["jaw.open"]
    if opened < closed:
        raise ParameterError(
            f"parameter jaw.open: {opened:g} lies below jaw.closed, {closed:g}; give a larger one"
        )
    return closed, opened


class JointReader:
    """Reader of the first position in a serialised JointState, whatever the joints' names."""

    def __init__(self) -> None:
        self._encoding = serialize_message(JointState())[:2]

    def read(self, raw: bytes) -> float:
        """Return the position, NaN if there is none. Real-time safe.

        CDR holds, after the four bytes of the encoding, stamp, frame, names and positions.
        """
        if raw[:2] != self._encoding or len(raw) > _LONGEST:
            return math.nan
        try:
            at = _aligned(_after_text(raw, 12), 4)
            (n_names,) = struct.unpack_from("=I", raw, at)
            at += 4
            for _ in range(min(n_names, _MOST_NAMES)):
                at = _aligned(_after_text(raw, at), 4)
            (n,) = struct.unpack_from("=I", raw, at)
            at = _aligned(at + 4, 8)
            (position,) = struct.unpack_from("=d", raw, at) if n else (math.nan,)
        except struct.error:
            return math.nan
        return float(position)


def _aligned(at: int, size: int) -> int:
    """Return the next offset that is aligned to a size, counted behind the encoding."""
    return ((at - 4 + size - 1) & -size) + 4


def _after_text(raw: bytes, at: int) -> int:
    """Return the offset behind a text that begins at an offset. Real-time safe."""
    (length,) = struct.unpack_from("=I", raw, at)
    return at + 4 + int(length)


class JawChannel:
    """The jaw of one tool.

    Attributes
    ----------
    thresholds : tuple of float
        Positions below which the jaw is closed, and above which it is open.
    shut : bool
        Whether the jaw is closed; open before the first message.
    """

    def __init__(self, subscription: Any, thresholds: tuple[float, float]) -> None:
        self.subscription = subscription
        self.publisher = None
        self.thresholds = thresholds
        self.shut = False
        self._reader = JointReader()

    def take(self) -> bool:
        """Take the newest message, if any; return whether the jaw is closed. Real-time safe."""
        taken = self.subscription.handle.take_message(JointState, True)
        if taken is not None:
            position = self._reader.read(taken[0])
            if math.isfinite(position):
                self.shut = position < self.thresholds[1 if self.shut else 0]
        return self.shut


def jaw_channel(
    ports: Ports,
    name: str,
    thresholds: tuple[float, float],
    period: float,
    polled: PolledSubscriptions,
) -> JawChannel:
    """Make the channel of a tool's jaw; the loop takes its messages itself."""
    subscription = ports.subscription(
        JointState,
        f"{name}/jaw/measured_js",
        lambda message: None,  # never called
        qos.poses(period),
        silent=True,
        callback_group=polled,
        raw=True,
    )
    return JawChannel(subscription, thresholds)
