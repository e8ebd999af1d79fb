"""Where commands write: nothing that is read or of others is lost, and nothing computed in vain."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import h5py
import pytest

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
)


@pytest.fixture(autouse=True)
def nothing_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    def begun(*_: object, **__: object) -> None:
        raise AvatarError("begun")

    for name in BUILDS:
        monkeypatch.setattr(name, begun)
    monkeypatch.setattr(cli, "require_ros", lambda: None)


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path):  # type: ignore[no-untyped-def]
    """Runs a command in a folder with one file of each kind, which stay as they are."""
    monkeypatch.chdir(tmp_path)
    for name in ("liver.obj", "tumour.obj", "groups.npz", "text.h5"):
        Path(name).write_text(name)
    for name, format_ in (
        ("v.h5", "avatar vademecum"),
        ("atlas.h5", "avatar atlas"),
        ("foreign.h5", "something else"),
    ):
        with h5py.File(name, "w") as file:
            file.attrs["format"] = format_
    Path("folder.h5").mkdir()
    Path("link.h5").symlink_to("liver.obj")
    os.link("tumour.obj", "hard.h5")
    Path("link.json").symlink_to("liver.obj")
    Path("link.vtu").symlink_to("v.h5")
    Path("gone.h5").symlink_to("nowhere")
    Path("old.vtu").write_text("<VTKFile/>")
    Path("old.json").write_text("{}")
    before = _contents(tmp_path)

    def run(command: str) -> str:
        monkeypatch.setattr(sys, "argv", ["avatar", *command.split()])
        assert cli.main() == 1
        (line,) = capsys.readouterr().err.splitlines()[-1:]
        assert _contents(tmp_path) == before
        return line.removeprefix("avatar: ")

    return run


def _contents(folder: Path) -> dict[str, bytes | None]:
    return {path.name: path.read_bytes() if path.is_file() else None for path in folder.iterdir()}


ORGAN = "vademecum liver.obj --tumour tumour.obj --groups groups.npz -o"
PATIENT = "patient liver.obj --atlas atlas.h5 -o"


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (f"{ORGAN} liver.obj", "choose .h5"),
        (f"{ORGAN} out", "choose .h5"),
        (f"{ORGAN} link.h5", "link.h5 is also read (liver.obj)"),
        (f"{ORGAN} link.h5 --overwrite", "is also read"),
        (f"{ORGAN} ../{{here}}/hard.h5", "is also read (tumour.obj)"),
        (f"{ORGAN} folder.h5", "is a folder"),
        (f"{ORGAN} folder.h5 --overwrite", "is a folder"),
        (f"{ORGAN} no/v.h5", "create it first"),
        (f"{ORGAN} text.h5", "--overwrite"),
        (f"{ORGAN} foreign.h5", "--overwrite"),
        (f"{ORGAN} gone.h5", "--overwrite"),
        (f"{ORGAN} atlas.h5", "no vademecum"),
        (f"{PATIENT} atlas.h5 --overwrite", "is also read (atlas.h5)"),
        (f"{PATIENT} ./atlas.h5", "is also read (atlas.h5)"),
        (f"{PATIENT} liver.obj", "choose .h5"),
        (f"{PATIENT} link.h5", "is also read (liver.obj)"),
        (f"{PATIENT} text.h5", "--overwrite"),
        (f"{PATIENT} folder.h5", "is a folder"),
        ("atlas create a.obj liver.obj", "choose .h5"),
        ("atlas create no/a.h5 liver.obj", "create it first"),
        ("atlas create folder.h5 liver.obj", "is a folder"),
        ("atlas create link.h5 liver.obj", "is also read"),
        ("export v.h5 -o v.h5", "choose .vtu or .xdmf"),
        ("export v.h5 -o link.vtu", "is also read (v.h5)"),
        ("export v.h5 -o no/v.vtu", "create it first"),
        ("bench step liver.obj -o liver.obj", "choose .json"),
        ("bench step liver.obj -o link.json", "is also read (liver.obj)"),
        ("bench effects liver.obj -o no/e.json", "create it first"),
        ("bench cell liver.obj -o liver.obj", "choose .json"),
        ("demo -o demo", "choose .png"),
        ("demo -o no/demo.png", "create it first"),
    ],
)
def test_refused_before_anything_is_computed(said, tmp_path, command, reason):  # type: ignore[no-untyped-def]
    assert reason in said(command.format(here=tmp_path.name))


@pytest.mark.parametrize(
    "command",
    [
        f"{ORGAN} new.h5",
        f"{ORGAN} v.h5",
        f"{ORGAN} text.h5 --overwrite",
        f"{ORGAN} gone.h5 --overwrite",
        f"{PATIENT} new.h5",
        f"{PATIENT} v.h5",
        f"{PATIENT} text.h5 --overwrite",
        "atlas create new.h5 liver.obj",
        "export v.h5 -o new.xdmf",
        "export v.h5 -o old.vtu",
        "bench step liver.obj -o old.json",
        "demo -o new.png --vertices 500",
    ],
)
def test_what_may_be_written_is_begun(said, command):  # type: ignore[no-untyped-def]
    assert said(command) == "begun"


@pytest.mark.parametrize(
    "command", [f"{ORGAN} new.h5", f"{PATIENT} new.h5", "export v.h5 -o a.vtu"]
)
def test_a_read_only_folder_is_refused(said, monkeypatch, command):  # type: ignore[no-untyped-def]
    # asked of os.access, because the superuser may write anywhere
    monkeypatch.setattr(os, "access", lambda _, mode, **__: not mode & os.W_OK)
    assert "cannot be written to" in said(command)
