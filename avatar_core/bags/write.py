"""A recording as MCAP, as ``ros2 bag record`` would have written the topics of its tools.

Stamps are the recorded ones; times of receipt are nominal, period by period from the first stamp.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from avatar_core.bags import types
from avatar_core.bags.periods import ORGAN
from avatar_core.bags.read import ABOUT, POSES, STATES, About
from avatar_core.common.arrays import FloatArray
from avatar_core.common.files import replaced
from avatar_core.contact.status import PLACED
from avatar_core.scene.recording import Recording
from avatar_core.scene.replay import scene_of

_METADATA_VERSION = 9  # version of rosbag2 in Jazzy


def write_mcap(recording: Recording, path: str | Path) -> None:
    """Write a recording as one MCAP file, which appears complete, replaces another, or not at all.

    Topics are ``/NAME/measured_cp``, ``/NAME/servo_cf`` (the sent force) and ``/contact_state``
    (the computed force, as one contact at the tip). ``/recording`` comes once (scene and vademecum,
    as JSON). Clouds are left out.

    Raises
    ------
    StorageError
        If rosbags is missing, or the file cannot be written.
    """
    library, path = types.rosbag2(), Path(path)
    names = [tool.name for tool in scene_of(recording).tools]
    with (
        replaced(path) as whole,
        tempfile.TemporaryDirectory(prefix=whole.name, dir=path.parent) as folder,
    ):
        # The library writes folders, and the file's name into the file.
        bag = Path(folder) / path.stem
        writer = library.Writer(
            bag, version=_METADATA_VERSION, storage_plugin=library.StoragePlugin.MCAP
        )
        writer.set_compression(library.CompressionMode.STORAGE, library.CompressionFormat.ZSTD)
        with writer:
            _Messages(writer, recording, names).write()
        (bag / f"{path.stem}.mcap").rename(whole)


class _Messages:
    """The messages of a recording, in the order of its periods."""

    def __init__(self, writer: Any, recording: Recording, names: list[str]) -> None:
        self._writer, self._recording, self._names = writer, recording, names
        self._store, self._topics = types.typestore(), {}
        shared = ((ABOUT, types.TEXT), (STATES, types.STATE))
        of_tools = [
            (f"{name}/{topic}", kind)
            for name in names
            for topic, kind in ((POSES, types.POSE), ("servo_cf", types.WRENCH))
        ]
        for topic, kind in (*shared, *of_tools):
            self._topics[topic] = writer.add_connection(f"/{topic}", kind, typestore=self._store)

    def write(self) -> None:
        recording, periods = self._recording, self._recording.periods
        about = About(
            recording.vademecum_id,
            recording.vademecum_name,
            recording.scene,
            float(recording.rate),
            bool(recording.from_rest),
        )
        since = np.rint((periods.number - periods.number[0]) * (1e9 / recording.rate))
        received = (periods.stamp[0] + since.astype(np.int64)).tolist()
        self._send(ABOUT, received[0], self._make(types.TEXT, about.text()))
        used = np.isin(periods.status, PLACED) & np.isfinite(periods.tip).all(axis=2)
        written = [-1 for _ in self._names]  # stamp of the last pose
        for k, stamp in enumerate(periods.stamp.tolist()):
            for i, name in enumerate(self._names):
                if used[k, i] and stamp != written[i]:
                    written[i] = stamp
                    pose = self._pose(stamp, periods.tip[k, i], periods.orientation[k, i])
                    self._send(f"{name}/{POSES}", received[k], pose)
            for i, name in enumerate(self._names):
                wrench = self._wrench(stamp, periods.force[k, i] * periods.sent_fraction[k, i])
                self._send(f"{name}/servo_cf", received[k], wrench)
                self._send(STATES, received[k], self._state(stamp, k, i))

    def _send(self, topic: str, received: int, message: Any) -> None:
        content = self._store.serialize_cdr(message, message.__msgtype__)
        self._writer.write(self._topics[topic], received, content)

    def _make(self, kind: str, *fields: Any) -> Any:
        return self._store.types[kind](*fields)

    def _header(self, stamp: int) -> Any:
        time = self._make("builtin_interfaces/msg/Time", *divmod(stamp, 1_000_000_000))
        return self._make("std_msgs/msg/Header", time, ORGAN)

    def _vector(self, values: FloatArray, kind: str = "Vector3") -> Any:
        return self._make(f"geometry_msgs/msg/{kind}", *values.tolist())

    def _pose(self, stamp: int, tip: FloatArray, orientation: FloatArray) -> Any:
        known = orientation if orientation.any() else np.array([0.0, 0.0, 0.0, 1.0])
        quaternion = self._vector(known, "Quaternion")
        pose = self._make("geometry_msgs/msg/Pose", self._vector(tip, "Point"), quaternion)
        return self._make(types.POSE, self._header(stamp), pose)

    def _wrench(self, stamp: int, force: FloatArray) -> Any:
        parts = (self._vector(force), self._vector(np.zeros(3)))
        wrench = self._make("geometry_msgs/msg/Wrench", *parts)
        return self._make(types.WRENCH, self._header(stamp), wrench)

    def _state(self, stamp: int, k: int, tool: int) -> Any:
        periods, unknown = self._recording.periods, np.full(3, np.nan)
        force, contacts = periods.force[k, tool], []
        if force.any():
            tip = self._vector(periods.tip[k, tool], "Point")
            parts = (tip, self._vector(unknown), self._vector(force), float("nan"))
            contacts = [self._make(types.CONTACT, *parts)]
        return self._make(
            types.STATE,
            self._header(stamp),
            self._names[tool],
            int(periods.status[k, tool]),
            self._recording.vademecum_id,
            contacts,
            float(periods.error[k, tool]),
            float(periods.sent_fraction[k, tool]),
            False,  # jaws are not recorded
        )
