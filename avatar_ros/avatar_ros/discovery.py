"""Who reaches a node: this machine only, unless the user says otherwise.

Nothing in this project authenticates anybody. Who wants other machines to take part exports
ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET; see msg_docs/security.md.
"""

from __future__ import annotations

import os
from collections.abc import MutableMapping
from pathlib import Path

from avatar_core.errors import AvatarError

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
LOCAL = "LOCALHOST"
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"  # as Fast DDS 2 reads it
_OTHER_PROFILES = "FASTDDS_DEFAULT_PROFILES_FILE"  # from Fast DDS 3 on
_PEERS = "ROS_STATIC_PEERS"
_PROFILE = Path("share", "avatar_ros", "params", "this_machine_only.xml")  # below a prefix


class DiscoveryError(AvatarError):
    """The installation is incomplete."""


def stay_local(environment: MutableMapping[str, str] = os.environ) -> None:
    """Keep this process and those that it starts on this machine; before ``rclpy.init()``.

    The range keeps nodes from looking for others, the profile from hearing them: with the range
    alone, who knows a node's address is answered. What the user has set stays as it is: another
    range, peers or a profile of the user's own.

    Raises
    ------
    DiscoveryError
        If the profile is not installed.
    """
    if environment.setdefault(RANGE, LOCAL) != LOCAL or environment.get(_PEERS):
        return
    if PROFILES not in environment and _OTHER_PROFILES not in environment:
        environment[PROFILES] = environment[_OTHER_PROFILES] = str(_profile())


def _profile() -> Path:
    for prefix in Path(__file__).parents:
        if (prefix / _PROFILE).is_file():
            return prefix / _PROFILE
    raise DiscoveryError(f"no {_PROFILE} above {__file__}; install avatar_ros again")
