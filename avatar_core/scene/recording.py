"""A recording of what a tool did and felt, on disk: HDF5 with schema version and checksum.

Layout (schema 1.0), attributes at the root: ``format`` = "avatar recording", ``schema``,
``vademecum_id``, ``vademecum_name``, ``scene`` (YAML, with the material that was in force),
``rate`` [Hz], ``from_rest``, ``checksum``. Datasets, n periods of the contact loop, t tools:

    periods/number (n,)          as the loop counts; a jump says how many were lost
    periods/stamp (n,) [ns]      of the pose of the first tool
    periods/tip (n, t, 3) [m]    sphere centres as the step used them: far away without a pose
    periods/turn (n, t, 3) [rad] of the tool since the period before, for friction
    periods/status (n, t)        of avatar_ros/msg/ContactState
    periods/force (n, t, 3) [N]  of the organ on the tool, before the force guard
    periods/error (n, t) [N]     that one contact in ten exceeds
    periods/share (n, t)         of the force that was sent: below 1 the guard held it back
    clouds/period (m,)           number of the last period before each cloud
    clouds/displacement (m, n_points, 3) [m], float32
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from avatar_core.common.hdf5 import checksum, replace_file
from avatar_core.errors import StorageError, one_line

FORMAT = "avatar recording"
SCHEMA_VERSION = "1.0"
MAX_FILE_BYTES = 4 << 30

_PERIODS = ("number", "stamp", "tip", "turn", "status", "force", "error", "share")
_CLOUDS = ("period", "displacement")
_TEXTS = ("format", "schema", "vademecum_id", "vademecum_name", "scene", "rate", "from_rest")


@dataclass(frozen=True, eq=False)
class Periods:
    """What the loop did, one entry a period; shapes as in the file."""

    number: np.ndarray
    stamp: np.ndarray
    tip: np.ndarray
    turn: np.ndarray
    status: np.ndarray
    force: np.ndarray
    error: np.ndarray
    share: np.ndarray

    def __len__(self) -> int:
        return len(self.number)

    @property
    def lost(self) -> np.ndarray:
        """Periods that are missing before each, shape (n,); 0 before the first."""
        return np.diff(self.number, prepend=self.number[:1] - 1) - 1


@dataclass(frozen=True, eq=False)
class Clouds:
    """How the organ looked meanwhile, at display rate; shapes as in the file."""

    period: np.ndarray
    displacement: np.ndarray


@dataclass(frozen=True, eq=False)
class Recording:
    """A tool's path over an organ, what it felt, and how the organ looked.

    vademecum_id : SHA-256 of the vademecum's file; ``vademecum_name`` is for people
    scene : YAML text: tips, effects and material in force
    rate : of the loop [Hz]
    from_rest : the model was new, and no tool had touched it before the first period
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
        """From the first pose to the last [s]; a loop that misses periods has fewer of them."""
        stamp = self.periods.stamp
        return float(stamp[-1] - stamp[0]) * 1e-9


def save_recording(recording: Recording, path: str | Path) -> None:
    """Write a recording; the file appears complete or not at all.

    Raises
    ------
    StorageError
        If the folder does not exist or the disk is full; nothing is left behind.
    """
    arrays = {f"periods/{name}": getattr(recording.periods, name) for name in _PERIODS}
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
    """Read and verify a recording.

    Raises
    ------
    StorageError
        For a missing, truncated, altered, foreign or newer file.
    """
    path = Path(path)
    if not path.is_file():
        raise StorageError(f"no recording at {path}; make one on the planning page")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise StorageError(f"{path} has {path.stat().st_size >> 20} MiB; is it a recording?")
    try:
        with h5py.File(path, "r") as file:
            return _read(file, path)
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:
        raise StorageError(
            f"{path} is no readable recording ({one_line(error, 120)}); "
            "it may be truncated: record again"
        ) from error


def _read(file: h5py.File, path: Path) -> Recording:
    if str(file.attrs.get("format", "")) != FORMAT:
        raise StorageError(f"{path} is HDF5 but no recording; give one of the planning page")
    texts = {key: str(file.attrs[key]) for key in _TEXTS}
    if int(texts["schema"].split(".")[0]) > int(SCHEMA_VERSION.split(".")[0]):
        raise StorageError(
            f"{path} has schema {texts['schema']}, this version reads up to {SCHEMA_VERSION}; "
            "upgrade avatar"
        )
    keys = [f"periods/{name}" for name in _PERIODS] + [f"clouds/{name}" for name in _CLOUDS]
    arrays = {key: _numbers(file[key], path) for key in keys}
    if str(file.attrs["checksum"]) != checksum(arrays, texts):
        raise StorageError(f"{path} was altered or damaged (checksum); record again")
    recording = Recording(
        vademecum_id=texts["vademecum_id"],
        vademecum_name=texts["vademecum_name"],
        scene=texts["scene"],
        rate=float(texts["rate"]),
        from_rest=texts["from_rest"] == "True",
        periods=Periods(*(arrays[f"periods/{name}"] for name in _PERIODS)),
        clouds=Clouds(*(arrays[f"clouds/{name}"] for name in _CLOUDS)),
    )
    _check_shapes(recording, path)
    return recording


def _numbers(dataset: object, path: Path) -> np.ndarray:
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "fiub":
        raise StorageError(f"{path}: '{dataset}' is no array of numbers; record again")
    if dataset.is_virtual or dataset.external or dataset.nbytes > path.stat().st_size:
        raise StorageError(f"{path}: '{dataset.name}' is not whole in the file; record again")
    return np.asarray(dataset[...])


def _check_shapes(recording: Recording, path: Path) -> None:
    p, c = recording.periods, recording.clouds
    n = len(p)
    n_tools = p.tip.shape[1] if p.tip.ndim == 3 else 0
    agree = (
        n > 0
        and all(a.shape == (n, n_tools, 3) for a in (p.tip, p.turn, p.force))
        and all(a.shape == (n, n_tools) for a in (p.status, p.error, p.share))
        and p.stamp.shape == (n,)
        and bool((p.lost >= 0).all())
        and c.displacement.ndim == 3
        and c.displacement.shape[0] == len(c.period)
        and recording.rate > 0.0
    )
    if not agree:
        raise StorageError(f"{path}: the arrays do not fit together; record again")
