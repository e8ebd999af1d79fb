"""A build survives interruptions."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from avatar_core.atlas import growth as atlas_build
from avatar_core.atlas.anatomy import AtlasError, WholeAnatomy
from avatar_core.atlas.frame import Frame
from avatar_core.atlas.growth import SurfaceFile, _folder_of, create_atlas, extend_atlas, key_of
from avatar_core.atlas.storage import SHAPE, load_atlas
from avatar_core.errors import StorageError
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.registration import Template
from tests.core.atlas.rough import (
    ALONE,
    OPTIONS,
    ROUGH,
    StopError,
    files_of,
    same,
    stop_after,
    write_obj,
    written,
)
from tests.helpers.paths import ROOT


def test_an_interrupted_build_goes_on_where_it_stopped(
    frame: Frame,
    livers: list[SurfaceMesh],
    members: list[WholeAnatomy],
    calls: list[str],
    tmp_path: Path,
) -> None:
    folder = tmp_path / "atlas"
    build = partial(
        create_atlas, folder, livers[:4], OPTIONS, template=frame.template, workers=ALONE
    )
    with pytest.raises(StopError):
        build(progress=stop_after(3))
    assert load_atlas(folder).names == ("liver0", "liver1", "liver2")
    (folder / "liver1" / SHAPE).unlink()  # last file of an anatomy: as if killed before writing it
    before = files_of(folder)
    calls.clear()
    seen: list[tuple[int, int]] = []
    growth = build(progress=lambda done, total, name: seen.append((done, total)))
    assert growth.known == ("liver0", "liver2") and calls == ["liver1", "liver3"]
    assert seen == [(3, 4), (4, 4)]
    kept = {name: file for name, file in before.items() if not name.startswith("liver1")}
    assert files_of(folder).items() > kept.items()
    assert same(load_atlas(folder), written(tmp_path / "other", frame, members[:4]))


def test_other_options_are_another_atlas(
    template: Template, livers: list[SurfaceMesh], calls: list[str], tmp_path: Path
) -> None:
    folder = tmp_path / "atlas"
    build = partial(create_atlas, folder, livers[:2], template=template, workers=ALONE)
    with pytest.raises(StopError):
        build(OPTIONS, progress=stop_after(1))
    before = files_of(folder)
    with pytest.raises(AtlasError, match="avatar atlas add"):
        build(replace(OPTIONS, rule=replace(ROUGH, n_stages=6)))
    assert files_of(folder) == before
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    (mixed / "thesis.txt").touch()
    with pytest.raises(AtlasError, match="is no atlas"):
        create_atlas(mixed, livers[:1], OPTIONS, template=template, workers=ALONE)
    assert [one.name for one in mixed.iterdir()] == ["thesis.txt"]


def test_a_key_is_of_the_bytes_and_the_reading_of_a_file(
    livers: list[SurfaceMesh], tmp_path: Path
) -> None:
    file = SurfaceFile(write_obj(tmp_path / "liver.obj", livers[0]))
    renamed = SurfaceFile(write_obj(tmp_path / "other.obj", livers[0]))
    readings = [file, replace(file, unit="cm"), replace(file, axes="LPS"), replace(file, label=1)]
    keys = [key_of(one) for one in readings]
    assert key_of(renamed) == keys[0]
    write_obj(file.path, livers[1])
    keys.append(key_of(file))
    assert len({*keys}) == 5 and None not in keys
    assert key_of(SurfaceFile(tmp_path / "missing.obj")) is None


def test_a_template_that_was_made_is_made_once(
    template: Template,
    livers: list[SurfaceMesh],
    monkeypatch: pytest.MonkeyPatch,
    calls: list[str],
    tmp_path: Path,
) -> None:
    made: list[int] = []
    monkeypatch.setattr(atlas_build, "default_template", lambda n: made.append(n) or template)
    build = partial(create_atlas, tmp_path / "atlas", livers[:2], OPTIONS, workers=ALONE)
    with pytest.raises(StopError):
        build(progress=stop_after(1))
    assert build().known == ("liver0",) and made == [OPTIONS.template_vertices]


@pytest.mark.parametrize("broken", ["fsync", "replace"])
@pytest.mark.parametrize("at", [1, 2])  # the level set; the shape
def test_a_full_disk_leaves_the_atlas_as_it_was(
    frame: Frame,
    members: list[WholeAnatomy],
    livers: list[SurfaceMesh],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    broken: str,
    at: int,
) -> None:
    folder = tmp_path / "atlas"
    atlas = written(folder, frame, members[:2])
    before = files_of(folder)
    working, n_calls = getattr(os, broken), 0

    def fails(*arguments: object) -> None:
        nonlocal n_calls
        n_calls += 1
        if n_calls == at:
            raise OSError(28, "No space left on device")
        working(*arguments)

    monkeypatch.setattr(os, broken, fails)
    with pytest.raises(StorageError, match="free disk space"):
        extend_atlas(folder, livers[2:3], workers=ALONE)
    assert files_of(folder).items() >= before.items() and same(load_atlas(folder), atlas)
    monkeypatch.setattr(os, broken, working)
    assert extend_atlas(folder, livers[2:3], workers=ALONE).added == ("liver2",)


def test_killed_in_the_middle_of_a_write(
    frame: Frame, members: list[WholeAnatomy], tmp_path: Path
) -> None:
    folder = tmp_path / "atlas"
    atlas = written(folder, frame, members[:2])
    before = files_of(folder)
    script = (
        "import os, signal, sys\n"
        "from dataclasses import replace\n"
        "from pathlib import Path\n"
        "from avatar_core.atlas.anatomy import WholeAnatomy\n"
        "from avatar_core.atlas.storage import load_atlas, save_anatomy\n"
        "os.fsync = lambda handle: os.kill(os.getpid(), signal.SIGKILL)\n"
        "atlas = load_atlas(sys.argv[1])\n"
        "shape = replace(atlas.anatomies[0], name='third')\n"
        "save_anatomy(Path(sys.argv[1]), WholeAnatomy(shape, atlas.vectors[0]))\n"
    )
    killed = subprocess.run([sys.executable, "-c", script, str(folder)], cwd=ROOT, check=False)
    assert killed.returncode == -9
    assert files_of(folder).items() >= before.items() and same(load_atlas(folder), atlas)


def test_two_builds_of_one_atlas_at_once_are_refused(
    template: Template, livers: list[SurfaceMesh], tmp_path: Path
) -> None:
    folder = tmp_path / "atlas"
    with _folder_of(folder):
        with pytest.raises(AtlasError, match="another build"):
            create_atlas(folder, livers[:1], OPTIONS, template=template, workers=ALONE)
        assert folder.is_dir()
    assert not any(tmp_path.iterdir())
