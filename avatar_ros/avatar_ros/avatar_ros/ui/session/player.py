"""Player of recordings in the library: play and scrub the recorded pictures and numbers."""

from __future__ import annotations

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from avatar_core.errors import AvatarError
from avatar_core.scene.file import parse_scene
from avatar_core.scene.recording import Periods, Recording, load_recording
from avatar_interfaces.msg import ContactState
from avatar_ros.framework.reader import Reader
from avatar_ros.ui.session.presets import values_of
from avatar_ros.ui.session.shown_period import PLACE, ShownPeriod, why_missing
from avatar_ros.ui.view.organ import Organ

_REPEATED = 1.0  # time for which the last state stays before it begins again [s]


class Played(NamedTuple):
    """A state of a recording.

    cloud : ndarray, shape (n, 6) [m]
    shown : numbers of each tool
    material : values by coordinate [SI]; given : those of them that somebody chose
    """

    cloud: np.ndarray
    shown: tuple[ShownPeriod, ...]
    material: dict[str, float]
    given: dict[str, float]


class Player:
    """Player of one recording at a time, of the organ that is shown and of no other.

    seconds : duration; is_on : whether its states are drawn in place of the present ones
    """

    def __init__(self, folder: Path, reader: Reader) -> None:
        self._folder, self._reader = folder, reader
        self._recording: Recording | None = None
        self._name = ""
        self._rows = np.zeros(0, int)  # period of each cloud
        self._valid = np.zeros(0, int)  # for each cloud, the last one within the range
        # for each cloud, the last one at which each tool was placed
        self._placed = np.zeros((0, 1), int)
        self._times = np.zeros(0)  # time of each cloud, from the first [s]
        self._given: dict[str, float] = {}  # values of the material, by coordinate [SI]
        self._place, self._began = 0.0, 0.0  # position [s], and the time when it was there
        self._runs = False

    @property
    def is_on(self) -> bool:
        """Return whether a recording is shown."""
        return self._recording is not None

    @property
    def seconds(self) -> float:
        """Return the duration of the recording's clouds [s]."""
        return float(self._times[-1]) if len(self._times) else 0.0

    @property
    def part(self) -> float:
        """Return the fraction that was played, 0 to 1."""
        return self.place / self.seconds if self.seconds > 0.0 else 0.0

    @property
    def place(self) -> float:
        """Return the time that is shown, from the first cloud on [s]."""
        if not self._runs:
            return self._place
        since = self._place + time.monotonic() - self._began
        return min(since % (self.seconds + _REPEATED), self.seconds)

    def open(self, name: str, organ: Organ, n_tools: int) -> str:
        """Play a recording of an organ and this number of tools; return why not, or ""."""
        self.close()
        path = self._folder / name
        try:
            size = path.stat().st_size
            found = self._reader.read(name, size, load_recording, path)
        except (OSError, AvatarError) as error:
            return str(error)
        if found.vademecum_id != organ.id:
            return f"{name} belongs to {found.vademecum_name}, another organ; load that organ first"
        n_points = len(organ.vertices)
        if found.clouds.displacement.shape[1:] != (n_points, 3):
            return f"{name} holds no surface that was shown; record again"
        n_recorded = found.periods.tip.shape[1]
        if n_recorded != n_tools:
            return f"{name} has {n_recorded} tools, the cell {n_tools}; start a cell with as many"
        number = found.periods.number
        rows = np.clip(np.searchsorted(number, found.clouds.period), 0, len(number) - 1)
        stamps = found.periods.stamp[rows]
        self._rows, self._times = rows, (stamps - stamps[0]) * 1e-9
        tips, status = found.periods.tip[rows], found.periods.status[rows]
        self._valid = _last((status != ContactState.STATUS_OUT_OF_RANGE).all(axis=1))
        self._placed = _last((np.abs(tips) < PLACE).all(axis=2))
        self._given = values_of(parse_scene(found.scene, found.vademecum_name))
        self._name, self._recording = name, found
        self._place, self._began, self._runs = 0.0, time.monotonic(), True
        return ""

    def is_playing(self, name: str) -> bool:
        """Return whether that recording is shown, moving or not."""
        return self.is_on and self._name == name

    def close(self) -> None:
        """Show the present state again."""
        self._recording, self._runs = None, False

    def pause(self, paused: bool) -> None:
        """Pause or go on."""
        self._place, self._began, self._runs = self.place, time.monotonic(), not paused

    def seek(self, part: float) -> None:
        """Pause at a fraction of the time, 0 to 1."""
        self._place, self._runs = part * self.seconds, False

    def state(self, organ: Organ) -> Played | None:
        """Return the state to show; None for the present one.

        As live, the last valid shape stays while a tool is beyond the range.
        """
        recording = self._recording
        if recording is None or recording.vademecum_id != organ.id:
            return None
        k = max(int(np.searchsorted(self._times, self.place, side="right")) - 1, 0)
        valid = int(self._valid[k])
        moved = recording.clouds.displacement[valid] if valid >= 0 else np.zeros((1, 3), np.float32)
        shown = self._shown(recording, k, float(np.linalg.norm(moved, axis=1).max()))
        cloud = np.hstack([organ.vertices + moved, np.broadcast_to(moved, organ.vertices.shape)])
        given = self._given
        material = {name: given.get(name, built) for name, (_, _, built) in organ.ranges.items()}
        return Played(cloud, shown, material, given)

    def _shown(self, recording: Recording, k: int, largest: float) -> tuple[ShownPeriod, ...]:
        """Return the numbers of each tool at a cloud, or at the last valid one."""
        periods, valid = recording.periods, int(self._valid[k])
        row, is_held = self._rows[valid], valid < k  # any row, where none is valid
        tips = [self._tip(periods, tool, k) for tool in range(periods.tip.shape[1])]
        status = periods.status[self._rows[k]]
        missing = why_missing(status) if is_held else [""] * len(tips)
        if valid < 0 or (is_held and not periods.force[row].any()):
            return tuple(map(ShownPeriod.without_force, tips, missing))
        return tuple(
            ShownPeriod(
                tip,
                periods.force[row, tool],
                float(periods.error[row, tool]) if periods.force[row, tool].any() else 0.0,
                largest,
                missing[tool],
                is_held,
                int(periods.status[row, tool]),
            )
            for tool, tip in enumerate(tips)
        )

    def _tip(self, periods: Periods, tool: int, k: int) -> np.ndarray:
        """Return where a tool was placed last, up to a cloud [m]."""
        placed = int(self._placed[k, tool])
        return periods.tip[self._rows[placed], tool] if placed >= 0 else np.full(3, PLACE)

    @property
    def alerts(self) -> list[str]:
        """Return the alert while a recording is shown."""
        if self._recording is None:
            return []
        return [
            f"Recording {self._name}, {self.place:.1f} of {self.seconds:.1f} s: "
            "not the present state"
        ]


def _last(known: np.ndarray) -> np.ndarray:
    """Return for each place along the first axis the last known one up to it, -1 before it."""
    places = np.arange(len(known)).reshape(-1, *[1] * (known.ndim - 1))
    return np.asarray(np.maximum.accumulate(np.where(known, places, -1)))
