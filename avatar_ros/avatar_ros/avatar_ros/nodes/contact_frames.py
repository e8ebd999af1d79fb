"""Frames of the cell for tf2: the organ in its parent, and the tools' frame in the organ's."""

from __future__ import annotations

import math

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from avatar_ros.loop.settings import LoopSettings

TOPIC = "/tf_static"  # outside the node's namespace, as tf2 requires


def static_transforms(settings: LoopSettings, stamp: Time) -> TFMessage:
    """Return the organ in ``parent_frame`` and the tools' frame in the organ's, if they differ."""
    organ, tools, parent = settings.frame_id, settings.safety.frame, settings.parent_frame
    found = []
    if parent not in ("", organ, tools):
        found.append(_transform(parent, organ, settings.parent_transform, stamp))
    if tools not in ("", organ):
        found.append(_transform(organ, tools, settings.safety.transform, stamp))
    return TFMessage(transforms=found)


def _transform(parent: str, child: str, pose: tuple[float, ...], stamp: Time) -> TransformStamped:
    """Return a transform; ``pose``: child in parent, x y z [m] and quaternion x y z w."""
    made = TransformStamped(child_frame_id=child)
    made.header.frame_id, made.header.stamp = parent, stamp
    to, turn = made.transform.translation, made.transform.rotation
    to.x, to.y, to.z = pose[:3]
    norm = math.hypot(*pose[3:])
    turn.x, turn.y, turn.z, turn.w = (number / norm for number in pose[3:])
    return made
