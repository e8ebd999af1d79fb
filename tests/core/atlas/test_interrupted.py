"""A build survives what interrupts it."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from avatar_core.atlas import growth as atlas_build
from avatar_core.atlas.anatomy import Anatomy, AtlasError
from avatar_core.atlas.checkpoint import checkpoint_of
from avatar_core.atlas.growth import (
    AnatomyBuilder,
    SurfaceFile,
    checkpoint_keys,
    create_atlas,
    extend_atlas,
    new_atlas,
)
from avatar_core.atlas.model import Atlas
from avatar_core.atlas.storage import load_atlas, save_atlas
from avatar_core.errors import StorageError
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.registration import Template
from tests.core.atlas.rough import ALONE, OPTIONS, ROUGH, StopError, same, stop_after, write_obj
from tests.helpers.paths import ROOT


def test_an_interrupted_build_goes_on_where_it_stopped(
    template: Template,
    livers: list[SurfaceMesh],
    members: list[Anatomy],
    calls: list[str],
    tmp_path: Path,
) -> None:
    file, folder = tmp_path / "a.h5", tmp_path / "a.h5.parts"
    build = partial(create_atlas, file, livers[:4], OPTIONS, template=template, workers=ALONE)
    with pytest.raises(StopError):
        build(progress=stop_after(3))
    assert not file.exists() and len(list(folder.iterdir())) == 3
    damaged = max(folder.iterdir())
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    calls.clear()
    seen: list[tuple[int, int]] = []
    growth = build(progress=lambda done, total, name: seen.append((done, total)))
    assert growth.resumed == 2 and len(calls) == 2  # the fourth, and the damaged one
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    assert not folder.exists()
    assert same(load_atlas(file), new_atlas(template, OPTIONS).with_anatomies(members[:4]))


def test_parts_of_another_template_or_rule_are_not_used(
    template: Template, livers: list[SurfaceMesh], calls: list[str], tmp_path: Path
) -> None:
    build = partial(create_atlas, tmp_path / "a.h5", livers[:2], template=template, workers=ALONE)
    with pytest.raises(StopError):
        build(OPTIONS, progress=stop_after(1))
    other = replace(OPTIONS, rule=replace(ROUGH, n_stages=6))
    calls.clear()
    assert build(other).resumed == 0 and len(calls) == 2
    assert [one.name for one in tmp_path.iterdir()] == ["a.h5"]


def test_a_part_belongs_to_the_bytes_and_the_reading_of_a_file(
    empty: Atlas, livers: list[SurfaceMesh], tmp_path: Path
) -> None:
    builder, path = AnatomyBuilder(empty), write_obj(tmp_path / "liver.obj", livers[0])
    file = SurfaceFile(path)
    readings = [file, replace(file, unit="cm"), replace(file, axes="LPS"), replace(file, label=1)]
    keys = checkpoint_keys(builder, readings) + checkpoint_keys(
        AnatomyBuilder(empty, print), [file]
    )
    write_obj(path, livers[1])
    keys += checkpoint_keys(builder, [file])
    assert len({*keys}) == 6 and None not in keys
    assert checkpoint_keys(builder, [SurfaceFile(tmp_path / "missing.obj")]) == [None]


def test_a_template_that_was_made_is_made_once(
    template: Template,
    livers: list[SurfaceMesh],
    monkeypatch: pytest.MonkeyPatch,
    calls: list[str],
    tmp_path: Path,
) -> None:
    made: list[int] = []
    monkeypatch.setattr(atlas_build, "default_template", lambda n: made.append(n) or template)
    build = partial(create_atlas, tmp_path / "a.h5", livers[:2], OPTIONS, workers=ALONE)
    with pytest.raises(StopError):
        build(progress=stop_after(1))
    assert build().resumed == 1 and made == [OPTIONS.template_vertices]


@pytest.mark.parametrize("broken", ["fsync", "replace"])
def test_a_crash_during_add_leaves_the_file_as_it_was(
    atlas: Atlas,
    livers: list[SurfaceMesh],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    calls: list[str],
    broken: str,
) -> None:
    file = tmp_path / "a.h5"
    save_atlas(atlas.without_anatomies().with_anatomies(atlas.anatomies[:2]), file)
    before = file.read_bytes()
    working, n_calls = getattr(os, broken), 0

    def fails_at_the_atlas(*arguments: object) -> None:
        nonlocal n_calls
        n_calls += 1
        if n_calls == 2:  # the first is the part's
            raise OSError(28, "No space left on device")
        working(*arguments)

    monkeypatch.setattr(os, broken, fails_at_the_atlas)
    with pytest.raises(StorageError, match="free disk space"):
        extend_atlas(file, livers[2:3], workers=ALONE)
    assert file.read_bytes() == before
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.h5", "a.h5.parts"]
    monkeypatch.setattr(os, broken, working)
    (tmp_path / "a.h5.parts" / ".killed.h5.tmp").touch()
    calls.clear()
    assert extend_atlas(file, livers[2:3], workers=ALONE).resumed == 1 and calls == []
    assert load_atlas(file).names == atlas.names[:3]
    assert list(tmp_path.iterdir()) == [file]


def test_killed_in_the_middle_of_a_write(atlas: Atlas, tmp_path: Path) -> None:
    file = tmp_path / "a.h5"
    save_atlas(atlas, file)
    before = file.read_bytes()
    script = (
        "import os, signal, sys\n"
        "from avatar_core.atlas.storage import load_atlas, save_atlas\n"
        "os.fsync = lambda handle: os.kill(os.getpid(), signal.SIGKILL)\n"
        "atlas = load_atlas(sys.argv[1])\n"
        "save_atlas(atlas.with_anatomies(atlas.anatomies[:1]), sys.argv[1])\n"
    )
    killed = subprocess.run([sys.executable, "-c", script, str(file)], cwd=ROOT, check=False)
    assert killed.returncode == -9
    assert file.read_bytes() == before and same(load_atlas(file), atlas)


def test_two_builds_of_one_atlas_at_once_are_refused(
    template: Template, livers: list[SurfaceMesh], tmp_path: Path
) -> None:
    file = tmp_path / "a.h5"
    with checkpoint_of(file):
        with pytest.raises(AtlasError, match="another build"):
            create_atlas(file, livers[:1], OPTIONS, template=template, workers=ALONE)
        assert (tmp_path / "a.h5.parts").is_dir()
    assert not any(tmp_path.iterdir())
