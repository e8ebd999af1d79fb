"""Reach of a node and its transport: this machine only, unless the user opens it.

Nothing in this project authenticates peers. To let other machines take part, export
ROS_AUTOMATIC_DISCOVERY_RANGE=SUBNET; see msg_docs/guides/security.md.

A node that must keep time does not use shared memory. With shared memory, Fast DDS checks whether
the port of a joining process is alive (``Port::healthy_check``). It sometimes sleeps for a third of
a second until the port is, and meanwhile holds a lock that all publishers need. The contact loop
stood still in 3 of 40 starts of another node. Over the loopback, a wrench arrives as fast. The
other nodes keep shared memory, for vademecums of 50 MB.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from pathlib import Path

from avatar_core.common.files import shipped
from avatar_core.errors import AvatarError

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
LOCAL = "LOCALHOST"
BY_PROFILE = "SYSTEM_DEFAULT"  # the profile sets the range; LOCALHOST would add shared memory
PROFILES = "FASTRTPS_DEFAULT_PROFILES_FILE"  # the variable that Fast DDS 2 reads
_OTHER_PROFILES = "FASTDDS_DEFAULT_PROFILES_FILE"  # the variable from Fast DDS 3 on
TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"  # the variable that counts without a profile
_PEERS = "ROS_STATIC_PEERS"
# prefix of its identifiers; other middleware reads neither profile nor transports
_FAST_DDS = "rmw_fastrtps"
_LOCAL_PROFILE = "this_machine_only.xml"
_UDP_PROFILE = "this_machine_udp.xml"


class DiscoveryError(AvatarError):
    """The installation is incomplete."""


def stay_local(environment: MutableMapping[str, str] = os.environ) -> None:
    """Restrict this process and those that it starts to this machine; before ``rclpy.init()``.

    The range keeps nodes from looking for others; the profile keeps others from reaching them. With
    the range alone, a node answers anybody who knows its address. A range, peers or a profile that
    the user has set stay as they are.

    Raises
    ------
    DiscoveryError
        If the profile is not installed.
    """
    if environment.setdefault(RANGE, LOCAL) != LOCAL or environment.get(_PEERS):
        return
    if PROFILES not in environment and _OTHER_PROFILES not in environment:
        environment[PROFILES] = environment[_OTHER_PROFILES] = str(_profile(_LOCAL_PROFILE))


@contextmanager
def udp_alone(
    middleware: str, environment: MutableMapping[str, str] = os.environ
) -> Iterator[None]:
    """Use only UDP while a time-critical node is made, but not in processes started later.

    Call ``stay_local`` first. A profile or transports that the user has set stay as they are.
    Middleware other than Fast DDS is left alone: it reads nothing but the range LOCALHOST.

    Parameters
    ----------
    middleware : str
        Identifier of the middleware in use, e.g. ``rmw_fastrtps_cpp``.
    environment : mapping, optional
        Environment variables; by default those of this process.

    Raises
    ------
    DiscoveryError
        If the profile is not installed.
    """
    names = (RANGE, PROFILES, _OTHER_PROFILES, TRANSPORTS)
    before = {name: environment[name] for name in names if name in environment}
    if middleware.startswith(_FAST_DDS):
        if environment.get(PROFILES) == str(_profile(_LOCAL_PROFILE)):
            environment[PROFILES] = environment[_OTHER_PROFILES] = str(_profile(_UDP_PROFILE))
            environment[RANGE] = BY_PROFILE
        elif PROFILES not in environment and _OTHER_PROFILES not in environment:
            environment.setdefault(TRANSPORTS, "UDPv4")
    try:
        yield
    finally:
        for name in names:
            environment.pop(name, None)
        environment.update(before)


def _profile(name: str) -> Path:
    path = shipped(name)
    if path is None:
        raise DiscoveryError(f"no file {name} of avatar_params; install avatar_params")
    return path
