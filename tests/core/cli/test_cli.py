"""The command: bad input is one clear line and exit code 1, and leaves no file behind."""

from __future__ import annotations

import json
import os
import re
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nrrd
import numpy as np
import pytest
import typer

from avatar_core.cli import main as cli
from avatar_core.cli.vademecum import _read_tumour, read_organ
from avatar_core.fem import patch_loads as loads
from avatar_core.geometry.mesh import tetrahedralize
from avatar_core.geometry.phantom import phantom_liver

TRIANGLE = "v 0 0 0\nv 100 0 0\nv 0 100 0\n"


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["avatar", *map(str, arguments)])
    return cli.main()


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in np.asarray(faces) + 1]
    path.write_text("\n".join(lines) + "\n")
    return path


def phantom_file(folder: Path, scale: float = 1e3) -> Path:
    liver = phantom_liver(12e-3)
    return write_obj(folder / "liver.obj", liver.vertices * scale, liver.faces)


@pytest.mark.parametrize(
    ("content", "remedy"),
    [
        (None, "check the path"),
        ("", "surface"),
        (TRIANGLE + "f 1 2 3\nf 1 3 2\n", "clos"),
        (TRIANGLE.replace("100 0 0", "nan 0 0") + "f 1 2 3\n", "finite"),
    ],
    ids=["missing", "empty", "two triangles", "NaN"],
)
def test_bad_surface(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    content: str | None,
    remedy: str,
) -> None:
    source = tmp_path / "organ.obj"
    if content is not None:
        source.write_text(content)
    refused(monkeypatch, capsys, tmp_path, [source], remedy)


def test_open_surface(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    liver = phantom_liver(12e-3)
    middle = liver.vertices[liver.faces].mean(axis=1)[:, 0]
    half = liver.faces[middle > np.median(middle)]
    source = write_obj(tmp_path / "half.obj", liver.vertices * 1e3, half)
    refused(monkeypatch, capsys, tmp_path, [source], "open")


@pytest.mark.parametrize("scale", [1e4, 10.0], ids=["too large", "too small"])
def test_wrong_unit(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    scale: float,
) -> None:
    refused(monkeypatch, capsys, tmp_path, [phantom_file(tmp_path, scale)], "unit")


@pytest.mark.parametrize(
    ("options", "remedy"),
    [
        (["--poisson", "0.5"], "0.4999"),
        (["--young", "-1"], "positive"),
        (["--patch-radius", "1e-12"], "radius"),
        (["--vertices", "3"], "at least"),
        (["--modes", "0"], "at least 1"),
        (["--tolerance", "0"], "between"),
        (["--element", "Q8"], "P2"),
        (["--axes", "XYZ"], "axes"),
        (["--unit", "inch"], "mm"),
        (["--groups", "nothing.npz"], "node groups"),
        (["--material", "rubber"], "neo-hookean"),
        (["--material", "neo-hookean", "--max-push", "0"], "20e-3"),
        (["--material", "neo-hookean", "--poisson", "0.495"], "0.49"),
        (["--material", "neo-hookean", "--element", "P1"], "P2"),
        (["--material", "neo-hookean", "--coordinate", "poisson=0.4:0.49"], "two vademecums"),
        (["--coordinate", "poisson=0.4:0.6"], "0.4999"),
        (["--support", "bare_area=soft"], "NAME=LOW:HIGH"),
        (["--support", "bare_area=0"], "free surface"),
        (["--support", "falciform", "--material", "neo-hookean"], "two vademecums"),
        (["--support", "falciform", "--contact-sites", "3"], "one linear material"),
        (["--contact-sites", "2"], "at least 3"),
        (["--contact-sites", "3", "--material", "neo-hookean"], "one linear material"),
    ],
)
def test_bad_option(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    options: list[str],
    remedy: str,
) -> None:
    source = phantom_file(tmp_path)
    small = [] if "--vertices" in options else ["--vertices", "800"]
    refused(monkeypatch, capsys, tmp_path, [source, *small, *options], remedy)


@pytest.mark.parametrize(
    ("states", "given", "read"),
    [("", None, "LPS"), ("# SPACE=RAS\n", None, "RAS"), ("", "LPI", "LPI")],
    ids=["the organ's", "its own", "those given"],
)
def test_axes_of_a_tumour(tmp_path: Path, states: str, given: str | None, read: str) -> None:
    organ = phantom_file(tmp_path)
    organ.write_text("# SPACE=LPS\n" + organ.read_text())
    tumour = tmp_path / "tumour.obj"
    tumour.write_text(states + organ.read_text().partition("\n")[2])
    surface = read_organ(str(organ), "mm", None, None)
    assert surface.axes_name == "LPS"
    assert _read_tumour(tumour, "mm", given, None, surface).axes_name == read


def test_a_tumour_in_a_label_map_lies_where_its_voxels_do(tmp_path: Path) -> None:
    """And has not the axes of the organ's file."""
    organ = phantom_file(tmp_path)
    organ.write_text("# SPACE=LPS\n" + organ.read_text())
    surface = read_organ(str(organ), "mm", None, None)
    values = np.zeros((12, 12, 12), np.uint8)
    values[3:9, 3:9, 3:9], values[0, 0, 0] = 4, 1
    fields = {
        "space": "LPS",
        "space directions": 3.0 * np.eye(3),
        "space origin": [20.0, 30.0, 40.0],
    }
    nrrd.write(str(tmp_path / "found.nrrd"), values, fields)
    tumour = _read_tumour(tmp_path / "found.nrrd", "mm", None, "4", surface)
    centre = 1e-3 * (np.array([20.0, 30.0, 40.0]) + 3.0 * 5.5) * [-1, -1, 1]
    np.testing.assert_allclose(tumour.vertices.mean(axis=0), centre, atol=1e-4)


@pytest.mark.long
def test_tolerance_out_of_reach_is_written_and_marked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(loads, "MIDPOINTS_FROM", 1.0)  # fewer load positions
    file = tmp_path / "v.h5"
    options = ["--vertices", "400", "--modes", "6", "--tolerance", "0.001", "--certify", "5"]
    assert run(monkeypatch, "vademecum", phantom_file(tmp_path), "-o", file, *options) == 3
    assert "not converged" in capsys.readouterr().err
    assert run(monkeypatch, "show", file, "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert shown["converged"] is False
    wanted = {"l2_mean", "l2_worst", "contact_mean", "contact_worst"}
    assert wanted | {"modes", "build_cpu_seconds", "bytes"} <= set(shown["certificate"])
    assert shown["certificate"]["build_cpu_seconds"] > 0


def test_show_refuses_what_is_no_vademecum(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "x.h5").write_bytes(b"nothing")
    assert run(monkeypatch, "show", tmp_path / "x.h5") == 1
    assert run(monkeypatch, "show", tmp_path / "y.h5") == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 2


def test_unknown_option_is_a_usage_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, "show", "--colour") == 2
    assert "--colour" in capsys.readouterr().err


@pytest.mark.parametrize("command", [[], ["vademecum"], ["show"], ["demo"], ["bench", "step"]])
def test_help(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    assert run(monkeypatch, *command, "--help") == 0
    assert "Usage" in capsys.readouterr().out


def commands(group: Any, *words: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command of a group, with the words that call it."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, *words, name)
        else:
            yield (*words, name), command


def test_help_shows_every_unit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    n_metres = 0
    for words, command in commands(typer.main.get_command(cli.app)):
        assert run(monkeypatch, *words, "--help") == 0
        shown = " ".join(capsys.readouterr().out.split())
        for parameter in command.params:
            units = re.findall(r"\[[^\]]+\]", parameter.help or "")
            n_metres += units.count("[m]")
            for unit in units:
                described = str(parameter.help).partition(unit)[0].split()[-1]
                assert f"{described} {unit}" in shown, (words, parameter.name)
    assert n_metres >= 5  # of vademecum, atlas create and export


def refused(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    folder: Path,
    arguments: list[object],
    remedy: str,
) -> None:
    before = set(folder.iterdir())
    code = run(monkeypatch, "vademecum", *arguments, "-o", folder / "v.h5")
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("avatar:")]
    assert code == 1
    assert len(lines) == 1
    assert remedy in lines[0]
    assert set(folder.iterdir()) == before


def test_ctrl_c_is_said_and_leaves_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def meshed_then_stopped(*_: object) -> None:
        tetrahedralize(phantom_liver(12e-3), 800)  # a library in there takes the signal for itself
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(10.0)

    source = phantom_file(tmp_path)
    monkeypatch.setattr("avatar_core.pipeline.build", meshed_then_stopped)
    # a shell starts what runs in the background with the signal ignored
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert run(monkeypatch, "vademecum", source, "-o", tmp_path / "liver.h5") == 130
    finally:
        signal.signal(signal.SIGINT, before)
    assert capsys.readouterr().err.splitlines()[-1].startswith("avatar: stopped")
    assert list(tmp_path.iterdir()) == [source]
