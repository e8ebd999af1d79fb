"""Recordings of a tool and of the forces on it, on disk: HDF5 with schema version and checksum.

Layout (schema 2.0). Attributes at the root: ``format`` = "avatar recording", ``schema``,
``vademecum_id``, ``vademecum_name``, ``scene`` (YAML, with the material in force), ``rate`` [Hz],
``from_rest``, ``checksum``. Datasets, for n periods of the contact loop and t tools:

    periods/number (n,)          counted by the loop; gaps are lost periods
    periods/stamp (n,) [ns]      time stamp of the first tool's pose
    periods/tip (n, t, 3) [m]    sphere centres as the step used them; far away without a pose
    periods/orientation (n, t, 4) of the tools' frames in the organ's, quaternions x y z w; zero
                                 where it is not known
    periods/status (n, t)        of avatar_interfaces/msg/ContactState
    periods/force (n, t, 3) [N]  force of the organ on the tool, before the force guard
    periods/error (n, t) [N]     estimated error of the force, exceeded by one contact in ten
    periods/share (n, t)         fraction of the force that was sent; below 1 if the guard cut it
    clouds/period (m,)           number of the period of each cloud
    clouds/displacement (m, n_points, 3) [m], float32
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar_core.common.files import FileError, opened
from avatar_core.common.hdf5 import replace_file, require_schema, verified
from avatar_core.errors import StorageError

FORMAT = "avatar recording"
SCHEMA_VERSION = "2.0"
MAX_FILE_BYTES = 4 << 30

_PERIODS = {  # fields of Periods, and their names in the file
    **{
        name: name for name in ("number", "stamp", "tip", "orientation", "status", "force", "error")
    },
    "sent_fraction": "share",
}
_CLOUDS = ("period", "displacement")
_KEYS = [f"periods/{key}" for key in _PERIODS.values()] + [f"clouds/{key}" for key in _CLOUDS]
_TEXTS = ("format", "schema", "vademecum_id", "vademecum_name", "scene", "rate", "from_rest")


@dataclass(frozen=True, eq=False)
class Periods:
    """Record of the contact loop, one entry per period; shapes as in the file."""

    number: np.ndarray
    stamp: np.ndarray
    tip: np.ndarray
    orientation: np.ndarray
    status: np.ndarray
    force: np.ndarray
    error: np.ndarray
    sent_fraction: np.ndarray

    def __len__(self) -> int:
        return len(self.number)

    @property
    def lost(self) -> np.ndarray:
        """Number of lost periods before each one, shape (n,); 0 for the first."""
        return np.diff(self.number, prepend=self.number[:1] - 1) - 1


@dataclass(frozen=True, eq=False)
class Clouds:
    """Displacements of the organ at display rate; shapes as in the file."""

    period: np.ndarray
    displacement: np.ndarray


@dataclass(frozen=True, eq=False)
class Recording:
    """A tool's path over an organ, the forces on it, and the displacements of the organ.

    Attributes
    ----------
    vademecum_id : str
        SHA-256 of the vademecum's file.
    vademecum_name : str
        Name of the organ, for messages.
    scene : str
        YAML text: tips, effects and material in force.
    rate : float
        Nominal rate of the loop [Hz].
    from_rest : bool
        Whether the model was new and untouched before the first period.
    """

    vademecum_id: str
    vademecum_name: str
    scene: str
    rate: float
    from_rest: bool
    periods: Periods
    clouds: Clouds

    @property
    def seconds(self) -> float:
        """Time from the first pose to the last [s]."""
        stamp = self.periods.stamp
        return float(stamp[-1] - stamp[0]) * 1e-9


def save_recording(recording: Recording, path: str | Path) -> None:
    """Write a recording; the file appears complete or not at all.

    Raises
    ------
    StorageError
        If the folder does not exist or the disk is full; nothing is left behind.
    """
    periods = recording.periods
    arrays = {f"periods/{key}": getattr(periods, name) for name, key in _PERIODS.items()}
    arrays |= {f"clouds/{name}": getattr(recording.clouds, name) for name in _CLOUDS}
    attributes = {
        "format": FORMAT,
        "schema": SCHEMA_VERSION,
        "vademecum_id": recording.vademecum_id,
        "vademecum_name": recording.vademecum_name,
        "scene": recording.scene,
        "rate": repr(float(recording.rate)),
        "from_rest": str(bool(recording.from_rest)),
    }
    replace_file(Path(path), arrays, attributes)


def load_recording(path: str | Path) -> Recording:
    """Read and verify a recording, as strictly as a vademecum.

    Raises
    ------
    StorageError
        For a missing, truncated, altered, foreign or newer file.
    """
    origin = str(path)
    try:
        with opened(Path(path), MAX_FILE_BYTES) as source:
            attributes, arrays = verified(
                source, origin, "recording", _attributes_of, lambda _: _KEYS, "record again"
            )
    except FileError as error:
        raise StorageError(
            f"no recording at {path} ({error}); make one on the planning page"
        ) from error
    recording = Recording(
        vademecum_id=attributes["vademecum_id"],
        vademecum_name=attributes["vademecum_name"],
        scene=attributes["scene"],
        rate=_rate(attributes["rate"]),
        from_rest=attributes["from_rest"] == "True",
        periods=Periods(*(arrays[f"periods/{key}"] for key in _PERIODS.values())),
        clouds=Clouds(*(arrays[f"clouds/{key}"] for key in _CLOUDS)),
    )
    if not _fits_together(recording):
        raise StorageError(f"{path}: the arrays do not fit together; record again")
    return recording


def _attributes_of(held: dict[str, str], origin: str) -> dict[str, str]:
    if held.get("format") != FORMAT:
        raise StorageError(f"{origin} is HDF5 but no recording; give one of the planning page")
    require_schema(held, SCHEMA_VERSION, origin, "record it again")
    return {key: held[key] for key in _TEXTS}


def _rate(text: str) -> float:
    """Return a positive number, or NaN."""
    try:
        rate = float(text)
    except ValueError:
        return math.nan
    return rate if 0.0 < rate < math.inf else math.nan


def _fits_together(recording: Recording) -> bool:
    p, c = recording.periods, recording.clouds
    n = len(p.number)
    n_tools = p.tip.shape[1] if p.tip.ndim == 3 else 0
    return (
        n > 0
        and p.number.shape == p.stamp.shape == (n,)
        and all(a.shape == (n, n_tools, 3) for a in (p.tip, p.force))
        and p.orientation.shape == (n, n_tools, 4)
        and all(a.shape == (n, n_tools) for a in (p.status, p.error, p.sent_fraction))
        and bool((p.lost >= 0).all())
        and c.displacement.ndim == 3
        and c.period.shape == c.displacement.shape[:1]
        and not math.isnan(recording.rate)
    )
