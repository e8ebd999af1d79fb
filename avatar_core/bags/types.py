"""The messages of a bag and their types, by the library rosbags (extra ``bags``)."""

from __future__ import annotations

import sys
from functools import lru_cache
from importlib import import_module
from types import ModuleType
from typing import Any

from avatar_core.errors import StorageError

POSE = "geometry_msgs/msg/PoseStamped"
WRENCH = "geometry_msgs/msg/WrenchStamped"
TEXT = "std_msgs/msg/String"
STATE = "avatar_interfaces/msg/ContactState"
CONTACT = "avatar_interfaces/msg/Contact"
INFO = "avatar_interfaces/msg/VademecumInfo"

# As in avatar_interfaces/msg, which the core does not have; types in a bag are not compiled.
OWN = {
    CONTACT: """
geometry_msgs/Point position
geometry_msgs/Vector3 normal
geometry_msgs/Vector3 force
float64 penetration
""",
    STATE: """
std_msgs/Header header
string tool
uint8 status
string vademecum_id
avatar_interfaces/Contact[] contacts
float64 force_error
float64 force_share
bool held
""",
    INFO: """
std_msgs/Header header
string id
string name
string source
string schema_version
string axes
uint32 n_vertices
uint32 n_surface_vertices
uint32 n_load_positions
uint32 n_modes
uint32 n_regions
uint64 bytes
float64 young_modulus
float64 poisson_ratio
float64 patch_radius
float64 volume
bool converged
float64 l2_mean
float64 l2_worst
float64 contact_mean
float64 contact_worst
float64 force_mean
float64 force_worst
float64 build_cpu_seconds
""",
}


def rosbag2() -> ModuleType:
    """Return the module of the library that reads and writes bags.

    Raises
    ------
    StorageError
        If the extra ``bags`` is not installed.
    """
    try:
        from rosbags import rosbag2
    except ImportError as error:
        raise StorageError("bags need rosbags; pip install '.[bags]'") from error
    module: ModuleType = rosbag2
    return module


def zstd() -> ModuleType:
    """Return Python's module for Zstandard, or the one that rosbags brings for older Pythons."""
    return import_module("compression.zstd" if sys.version_info >= (3, 14) else "backports.zstd")


@lru_cache(maxsize=1)
def typestore() -> Any:
    """Return the library's store of the types of Jazzy, and of ``OWN``."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(
        {
            name: definition
            for name_of, text in OWN.items()
            for name, definition in get_types_from_msg(text, name_of).items()
        }
    )
    return store


def full_name(name: str) -> str:
    """Return a type's name with the ``/msg/`` that some writers leave out.

    Bags of version 0.2.0 have the types of avatar_interfaces under ``avatar_ros``.
    """
    package, slash, rest = name.partition("/")
    if package == "avatar_ros":
        package = "avatar_interfaces"
    return f"{package}{slash}{rest}" if "/" in rest or not slash else f"{package}/msg/{rest}"
