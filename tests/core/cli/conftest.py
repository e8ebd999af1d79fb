"""Commands that are tried without their work."""

from __future__ import annotations

import pytest

from avatar_core.cli import bench, cell
from avatar_core.cli import main as cli
from avatar_core.errors import AvatarError

BUILDS = (
    "avatar_core.pipeline.build",
    "avatar_core.geometry.surface.read_surface",
    "avatar_core.geometry.tumour.read_tumour",
    "avatar_core.atlas.storage.load_atlas",
    "avatar_core.atlas.growth.create_atlas",
    "avatar_core.scene.export.export",
    "avatar_core.vademecum.storage.load_vademecum",
    "avatar_core.studies.bench.step.run_step_bench",
    "avatar_core.studies.bench.effects.build_for_effects",
    "avatar_core.studies.study.Study.conduct",
    "os.execv",  # by which a cell begins
)


@pytest.fixture
def nothing_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    def begun(*_: object, **__: object) -> None:
        raise AvatarError("begun")

    for name in BUILDS:
        monkeypatch.setattr(name, begun)
    for module in (cli, bench, cell):
        monkeypatch.setattr(module, "require_ros", lambda: None)
