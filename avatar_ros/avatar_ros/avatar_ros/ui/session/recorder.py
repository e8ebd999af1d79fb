"""Records poses, forces and clouds of a session at the planning page."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from avatar_core.contact.effects import Tumour
from avatar_core.contact.layout import default_effects
from avatar_core.reduction.coordinates import RESECTION, stiffness_of
from avatar_core.scene.file import write_scene
from avatar_core.scene.model import Scene, SupportStiffness, Tool
from avatar_core.scene.recording import Clouds, Periods, Recording, save_recording
from avatar_core.vademecum.accuracy import Cloud
from avatar_core.vademecum.model import Vademecum
from avatar_ros.ui.tools.tool_state import N_ROWS, SharedToolState

_MOST_BYTES = 1 << 30  # largest size of all surfaces in a recording


def scene_in_force(
    chosen: Scene | None,
    vademecum: Vademecum,
    material: dict[str, float],
    tools: tuple[Tool, ...],
    cloud: Cloud = "surface",
    cloud_divisor: int = 1,
) -> Scene:
    """Return the scene that reproduces the present state, including its material.

    chosen : None for the natural effects of the vademecum, with tools and cloud as given
    material : values by coordinate, which override those of the scene
    """
    scene = chosen or Scene(
        name="natural effects",
        tools=tools,
        cloud=cloud,
        cloud_divisor=cloud_divisor,
        effects=default_effects(vademecum, [tool.tip for tool in tools]),
    )
    effects = scene.effects
    if "contrast" in material:
        others = (effect for effect in effects if not isinstance(effect, Tumour))
        effects = (*others, Tumour(material["contrast"]))
    supports = {one.name: one for one in scene.supports} | {
        name: SupportStiffness(name, k) for name, k in stiffness_of(material).items()
    }
    return replace(
        scene,
        effects=effects,
        supports=tuple(supports.values()),
        young_modulus=material.get("young", scene.young_modulus),
        poisson_ratio=material.get("poisson", scene.poisson_ratio),
        resection=material.get(RESECTION, scene.resection),
    )


class Recorder:
    """Recorder of one recording at a time: ``open``, ``begin``, ``save``."""

    def __init__(self, state: SharedToolState) -> None:
        self._state = state
        self._clouds: list[np.ndarray] = []
        self._after: list[int] = []
        self._begin = -1
        self._about: tuple[str, str, str, float] = ("", "", "", 0.0)

    @property
    def is_on(self) -> bool:
        """Return whether periods are being recorded."""
        return bool(self._state.all["recording"][0])

    @property
    def is_full(self) -> bool:
        """Return whether the space for periods or for surfaces is full."""
        n = len(self._clouds)
        return self.is_on and (
            int(self._state.all["n_rows"][0]) >= N_ROWS
            or (n > 0 and n * self._clouds[0].nbytes > _MOST_BYTES)
        )

    @property
    def n_periods(self) -> int:
        """Return the number of recorded periods; none until the new model is in use."""
        return int(self._state.all["n_rows"][0]) - self._begin if self._begin >= 0 else 0

    def open(self, vademecum: Vademecum, scene: Scene, rate: float) -> str:
        """Record from now on, before the new model is in use; return the scene's text."""
        text = write_scene(scene)
        self._about = (vademecum.id, vademecum.name, text, rate)
        self._clouds, self._after, self._begin = [], [], -1
        self._state.all["n_rows"][0] = 0
        self._state.all["recording"][0] = 1
        return text

    def begin(self) -> None:
        """Discard earlier periods: the new model is in use."""
        self._begin = int(self._state.all["n_rows"][0])

    def note_cloud(self, displacement: np.ndarray, period: int) -> None:
        """Record a shown cloud, (n_points, 3) [m], with the number of its period."""
        n = int(self._state.all["n_rows"][0])
        if self._begin >= 0 and n > self._begin:
            first = int(self._state.rows["number"][0, self._begin])
            if period >= first:
                self._clouds.append(displacement.astype(np.float32))
                self._after.append(period)

    def drop(self) -> None:
        """Stop and discard the recording."""
        self._state.all["recording"][0] = 0
        self._begin = -1

    def save(self, folder: Path) -> tuple[Path, Recording] | None:
        """Stop and write a file named by the time; return None if nothing was recorded.

        Raises
        ------
        StorageError
            If the file could not be written.
        """
        begin = self._begin
        self.drop()
        rows = self._state.recorded()
        if begin < 0 or rows.shape[1] <= begin:
            return None
        identity, name, scene, rate = self._about
        kept, before = rows[:, begin:], rows[:, :begin]
        size = self._clouds[0].shape if self._clouds else (0, 3)
        same = [i for i, cloud in enumerate(self._clouds) if cloud.shape == size]
        recording = Recording(
            vademecum_id=identity,
            vademecum_name=name,
            scene=scene,
            rate=rate,
            from_rest=not before["force"].any(),
            periods=_periods(kept),
            clouds=Clouds(
                np.array([self._after[i] for i in same], np.int64),
                np.array([self._clouds[i] for i in same], np.float32).reshape(len(same), *size),
            ),
        )
        path = folder / time.strftime("recording-%Y%m%d-%H%M%S.h5")
        save_recording(recording, path)
        return path, recording


def _periods(rows: np.ndarray) -> Periods:
    """Return the recorded periods of rows (n_tools, n)."""
    rows = rows.T.copy()
    return Periods(
        number=rows["number"][:, 0].copy(),
        stamp=rows["stamp"][:, 0].copy(),
        tip=rows["tip"].copy(),
        orientation=np.tile([0.0, 0.0, 0.0, 1.0], (*rows["tip"].shape[:2], 1)),  # upright
        status=rows["status"].astype(np.uint8),
        force=rows["force"].copy(),
        error=rows["error"].copy(),
        sent_fraction=rows["sent_fraction"].copy(),
    )
