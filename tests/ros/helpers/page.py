"""A planning page without cell and browser: states as the cell sends them, and stand-ins."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel
import numpy as np

from avatar_core.scene.file import write_scene
from avatar_core.scene.model import Scene
from avatar_core.scene.recording import Clouds, Periods, Recording
from avatar_interfaces.msg import ContactState
from avatar_ros.ui.tools.tool_state import ROW, SharedToolState
from avatar_ros.ui.view.organ import Organ

OK, OUT = ContactState.STATUS_OK, ContactState.STATUS_OUT_OF_RANGE
NAMES = ("left", "right")  # names of two tools
PLACES = np.array([[0.0, 0.1, 0.0], [0.05, 0.1, 0.0]])  # places of the two tools' tips [m]
TIP = PLACES[0]
UP = np.array([0.0, 0.0, 1.0])


class Noted:
    """Stand-in for any part of cell or page: notes its calls, and may answer.

    calls : names and positional arguments of the calls; given answers are called with them
    """

    def __init__(self, **answers: Callable[..., Any]) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self._answers = answers

    def __getattr__(self, name: str) -> Callable[..., Any]:
        def ask(*given: Any, **named: Any) -> Any:
            self.calls.append((name, *given))
            return self._answers[name](*given, **named) if name in self._answers else None

        return ask

    def of(self, name: str) -> list[Any]:
        """Return the first arguments of the calls of a name."""
        return [call[1] for call in self.calls if call[0] == name]


class AtOnce:
    """Reader that needs no process."""

    def read(self, name: str, n_bytes: int, function: Any, *given: Any) -> Any:
        return function(*given)


def rows(*tools: tuple[int, float], stamp: int = 5, organ: int = 0) -> np.ndarray:
    """Return a period by status and upward force [N] of each tool."""
    out = np.zeros(len(tools), ROW)
    out["stamp"], out["tip"], out["sent_fraction"] = stamp, PLACES[: len(tools)], 1.0
    out["status"] = [status for status, _ in tools]
    out["force"][:, 1] = [force for _, force in tools]
    out["touches"], out["organ"] = out["force"][:, 1] > 0.0, organ
    return out


def send(state: SharedToolState, period: np.ndarray) -> None:
    """Write a period as from the contact node."""
    n = int(state.all["n_recent"][0])
    state.recent[:, n % state.recent.shape[1]] = period
    state.all["n_recent"] = n + 1


def periods(number: np.ndarray, n_tools: int = 1, **given: np.ndarray) -> Periods:
    """Return periods recorded at 1 kHz; by default the tools touch nothing."""
    n = len(number)
    plain = {
        "number": number,
        "stamp": number * 1_000_000,
        "tip": np.tile(PLACES[:n_tools], (n, 1, 1)),
        "orientation": np.tile([0.0, 0.0, 0.0, 1.0], (n, n_tools, 1)),
        "status": np.zeros((n, n_tools), np.uint8),
        "force": np.zeros((n, n_tools, 3)),
        "error": np.full((n, n_tools), 0.1),
        "sent_fraction": np.ones((n, n_tools)),
    }
    return Periods(**plain | given)


def recording(
    shown: Organ, of: Periods, scene: Scene, moved: np.ndarray | None = None
) -> Recording:
    """Return a recording with a cloud every twenty periods, moved by ``moved`` (n,) along y [m]."""
    chosen = of.number[::20]
    displacement = np.zeros((len(chosen), *shown.vertices.shape), np.float32)
    if moved is not None:
        displacement[:, :, 1] = moved[:, None]
    clouds = Clouds(chosen, displacement)
    return Recording(shown.id, shown.name, write_scene(scene), 1000.0, True, of, clouds)


def image(path: Path, values: np.ndarray, affine: np.ndarray | None = None) -> Path:
    """Write voxels as a NIfTI file, in mm."""
    nibabel.save(nibabel.Nifti1Image(values, np.eye(4) if affine is None else affine), path)
    return path


def face_area(points: np.ndarray, faces: np.ndarray) -> float:
    """Return the area of all faces together [m^2]."""
    a, b, c = points[faces].swapaxes(0, 1).astype(float)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
