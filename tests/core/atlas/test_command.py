"""avatar atlas: create, add, show, continue, refuse."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from avatar_core.atlas import growth as atlas_build
from avatar_core.atlas.growth import AtlasOptions
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.registration import Template, TemplateRule
from tests.core.atlas.rough import ROUGH, Command, files_of, write_obj


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, avatar: Command, template: Template) -> Command:
    """Run ``avatar atlas`` with a small template and a rough registration."""
    monkeypatch.setattr(atlas_build, "default_template", lambda n: template)
    monkeypatch.setattr(atlas_build, "AtlasOptions", partial(AtlasOptions, rule=ROUGH))
    return partial(avatar, "atlas")


@pytest.mark.long
def test_create_add_and_show(run: Command, livers: list[SurfaceMesh], tmp_path: Path) -> None:
    file, folder = tmp_path / "atlas", tmp_path / "livers"
    folder.mkdir()
    for liver in livers[:2]:
        write_obj(folder / f"{liver.name}.obj", liver)
    (folder / "empty.obj").touch()
    (folder / "notes.txt").write_text("no surface")
    code, out, err = run("create", file, folder, "--spacing", 0.02, "--jobs", 1)
    assert code == 0 and "2 of 3 added, 1 skipped; 2 anatomies" in out
    assert "skipped: empty:" in err and "Traceback" not in err

    twin = tmp_path / "twin.obj"
    twin.write_text((folder / "liver0.obj").read_text() + "\n")  # an equal shape in another file
    code, out, err = run("add", file, folder / "liver1.obj", twin, "--jobs", 1)
    assert code == 0 and "1 of 2 added, 1 there before, 0 skipped; 3 anatomies" in out
    assert "notice: twin has the same shape as liver0" in err

    code, out, _ = run("show", file, "--json")
    shown = json.loads(out)
    assert code == 0 and shown["n_anatomies"] == 3 and shown["n_duplicates"] == 1
    assert shown["bytes"] == sum(one.stat().st_size for one in file.rglob("*.h5"))
    assert shown["box"]["spacing"] == 0.02
    assert shown["box"]["n_points"] == np.prod(shown["box"]["shape"])
    assert [one["duplicate_of"] for one in shown["anatomies"]] == [None, None, "liver0"]
    for one, liver in zip(shown["anatomies"], livers[:2], strict=False):
        assert one["name"] == liver.name and one["axes"] == "RAS"
        assert one["volume"] == pytest.approx(liver.volume, rel=1e-6)
        assert 0 < one["mean_distance"] < ROUGH.largest_mean
    code, out, _ = run("show", file)
    assert code == 0 and "duplicate of liver0" in out and "3 anatomies (1 duplicates)" in out


@pytest.mark.parametrize(
    "more",
    [
        pytest.param(("--shapes-only",), id="shapes"),
        pytest.param((), id="responses", marks=pytest.mark.long),
    ],
)
def test_a_stopped_command_goes_on(
    run: Command,
    livers: list[SurfaceMesh],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    more: tuple[str, ...],
) -> None:
    options = ("--spacing", 0.02, "--jobs", 1, *more)
    file = tmp_path / "atlas"
    files = [write_obj(tmp_path / f"{liver.name}.obj", liver) for liver in livers[:2]]
    register_template = atlas_build.register_template

    def stopped(template: Template, surface: SurfaceMesh, rule: TemplateRule):
        if surface.name == "liver1":
            raise KeyboardInterrupt
        return register_template(template, surface, rule)

    monkeypatch.setattr(atlas_build, "register_template", stopped)
    code, _, err = run("create", file, *files, *options)
    assert code == 130 and "run the same command again" in err
    monkeypatch.setattr(atlas_build, "register_template", register_template)
    code, out, _ = run("create", file, *files, *options)
    assert code == 0 and "1 of 2 added, 1 there before" in out


def test_the_command_refuses_clearly(
    run: Command, folder: Path, livers: list[SurfaceMesh], tmp_path: Path
) -> None:
    file, liver = tmp_path / "atlas", write_obj(tmp_path / "liver0.obj", livers[0])
    hollow, new = tmp_path / "hollow", tmp_path / "new"
    hollow.mkdir()
    shutil.copytree(folder, file)
    before = files_of(file)
    for arguments, remedy in [
        (["create", file, liver], "avatar atlas add"),
        (["create", new, hollow], "should hold"),
        (["create", new, tmp_path / "missing.obj", "--jobs", 1], "nothing was"),
        (["create", tmp_path / "no" / "new", liver], "create it first"),
        (["create", liver, liver], "give the name of a folder"),
        (["create", tmp_path, liver], "is no atlas"),
        (["create", new, liver, "--spacing", 0], "spacing"),
        (["create", new, liver, "--unit", "inch"], "--unit"),
        (["create", new, liver, "--axes", "XYZ"], "axes"),
        (["create", new, liver, "--box", 0.1, 0.1, 0.1, "--jobs", 1], "--box"),
        (["add", new, liver], "avatar atlas create"),
        (["add", file, liver, "--jobs", 0], "--jobs"),
        (["add", file, liver, "--unit", "m", "--jobs", 1], "--unit"),
        (["show", new], "avatar atlas create"),
        (["show", liver], "atlas"),
    ]:
        code, _, err = run(*arguments)
        assert code == 1, arguments
        assert remedy in err and "Traceback" not in err, (arguments, err)
    assert files_of(file) == before
    assert sorted(one.name for one in tmp_path.iterdir()) == ["atlas", "hollow", "liver0.obj"]
