"""An option is used or refused: a command ignores none."""

from __future__ import annotations

import os
import re
import sys
from itertools import pairwise
from pathlib import Path
from typing import get_args

import pytest

from avatar_core.atlas.patient import Fidelity
from avatar_core.errors import AvatarError
from tests.core.conftest import Command
from tests.helpers.paths import ROOT


@pytest.fixture
def said(
    nothing_is_computed: None, avatar: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Command:
    """Run a command in an empty folder; return its exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    return lambda command: avatar(*command.split())


@pytest.mark.parametrize(
    ("command", "unused"),
    [
        ("bench step v.h5 --vertices 2850", "--vertices is for a surface"),
        (
            "bench step v.h5 --unit m --axes RAS --label 1 --displayed 0",
            "--unit, --axes, --label, --displayed are for a surface, and v.h5 is built already",
        ),
        ("bench effects v.h5 --modes 60 --vertices 900", "--vertices, --modes are for a surface"),
        ("bench cell v.h5 --vertices 900", "--vertices is for a surface"),
        ("bench step phantom --unit m", "--unit is for files, and the built-in liver is none"),
        ("bench effects --label 1", "--label is for files"),
        ("vademecum phantom --unit mm -o a.h5", "--unit is for files"),
        ("vademecum phantom --axes RAS --label 1 -o a.h5", "--axes, --label are for files"),
        ("vademecum phantom --tumour t.stl --label 1 -o a.h5", "--label is for files"),
        ("vademecum phantom --max-push 0.01 -o a.h5", "--max-push is for large deformation"),
        ("vademecum phantom --pushed 12 -o a.h5", "--pushed is for large deformation"),
        ("patient phantom --atlas a --unit m -o a.h5", "--unit is for files"),
        ("atlas create a phantom --unit m", "--unit is for files"),
        ("atlas create a phantom --axes RAS --label 1", "--axes, --label are for files"),
        ("atlas add a phantom --label 1", "--label is for files"),
        ("atlas create a liver.obj phantom --label 1", "--label is for label maps"),
        ("export v.h5 -o a.stl --modes 3", "--modes is for .vtu and .xdmf"),
        ("export v.h5 -o a.vtu --unit m --axes RAS", "--unit, --axes are for surfaces, and .vtu"),
        ("export v.h5 -o a.xdmf --unit mm", "--unit is for surfaces, and .xdmf is in m and RAS"),
        (
            "export r.h5 -o a.mcap --at 0,0,0 --force 1 --modes 3 --unit m --axes RAS",
            "--at, --force, --modes, --unit, --axes are for a vademecum, and .mcap",
        ),
        (
            "register v.h5 --points c.xyz -o a.stl --frame known --shift 0.01 --turn 10",
            "--shift, --turn are for --frame camera",
        ),
        (
            "replay r.h5 --vademecum v.h5 --scene palpation",
            "--scene is for bags, and this is a recording of the page, which holds its scene",
        ),
        (
            "replay r.h5 --vademecum v.h5 --tool a --tool-transform 0,0,0,0,0,0,1 --rate 1000 "
            "--device sigma",
            "--tool, --tool-transform, --rate, --device are for bags",
        ),
        (
            "calibrate v.h5 --recording r.h5 --radius 5 --tool-transform 0,0,0,0,0,0,1",
            "--tool-transform, --radius are for bags",
        ),
        ("demo --ui --cell --seconds 9 -o a.png", "--output, --cell, --seconds are not for --ui"),
        ("demo --seconds 9", "--seconds is for --cell"),
        ("demo --host 0.0.0.0 --port 1", "--host, --port are for the planning page"),
        ("cell --port 8080", "--host and --port are for the planning page; add --ui"),
        ("study grid -o a --resume", "--resume is for studies that keep their rows, and grid"),
    ],
)
def test_an_option_that_would_be_ignored_is_refused(
    said: Command, tmp_path: Path, command: str, unused: str
) -> None:
    code, out, err = said(command)
    assert code == 1 and err.startswith(f"avatar: {unused}") and err.count("\n") == 1
    assert "leave " in err and not out and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "command",
    [
        "bench step phantom --vertices 900 --displayed 0",
        "vademecum phantom --tumour t.stl --unit m --axes RAS -o a.h5",
        "vademecum phantom --material neo-hookean --max-push 0.01 --pushed 2 -o a.h5",
        "atlas create a phantom liver.obj --unit m --axes RAS",
        "atlas create a phantom ct.nrrd --label 1",
        "export v.h5 -o a.stl --at 0,0,0 --force 2 --unit m --axes RAS",
        "export v.h5 -o a.vtu --at 0,0,0 --force 2 --modes 3",
        "demo --cell --seconds 9 -o a.png",
        "demo --ui --host 0.0.0.0 --port 8081",
        "study meshes -o a --resume",
    ],
)
def test_an_option_that_is_used_is_taken(
    said: Command, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.setattr("avatar_core.cli.main.require_ui", lambda: None)
    code, _, err = said(command)
    assert code == 1 and err.splitlines()[-1] == "avatar: begun"


@pytest.mark.parametrize(
    ("options", "page"),
    [
        ("", {}),
        ("--host 0.0.0.0", {"--host": "0.0.0.0"}),
        ("--port 8080 --host 127.0.0.1", {"--host": "127.0.0.1", "--port": "8080"}),
    ],
)
def test_the_page_keeps_the_address_of_the_parameter_file(
    said: Command, monkeypatch: pytest.MonkeyPatch, options: str, page: dict[str, str]
) -> None:
    def begun(_: str, command: list[str]) -> None:
        words = dict(pairwise(command))
        assert {name: words[name] for name in ("--host", "--port") if name in words} == page
        raise AvatarError("begun")

    Path("cell.yaml").touch()
    monkeypatch.setattr("avatar_core.cli.cell.require_ui", lambda: None)
    monkeypatch.setattr(os, "chdir", lambda _: None)
    monkeypatch.setattr(os, "execv", begun)
    code, _, err = said(f"cell --params cell.yaml --ui {options}")
    assert code == 1 and err == "avatar: begun\n"


@pytest.mark.parametrize(
    ("command", "code", "reason"),
    [
        ("vademecum phantom -o a.h5 --seed -1", 2, "--seed"),
        ("uncertainty v.h5 --given young=fixed:5e3 --seed -1", 2, "--seed"),
        ("bench idle --seconds -3", 1, "--seconds is -3; give at least 1"),
        ("bench idle --seconds nan", 1, "--seconds is nan; give at least 1"),
        ("bench cell v.h5 --seconds 0", 1, "--seconds is 0; give at least 1"),
        ("bench cell v.h5 --changes -1", 1, "--changes is -1 Hz; give 0 to 1000"),
        ("demo --cell --seconds -3", 1, "--seconds is -3; give at least 1"),
    ],
)
def test_a_negative_number_is_refused_first(
    said: Command, monkeypatch: pytest.MonkeyPatch, command: str, code: int, reason: str
) -> None:
    monkeypatch.setattr("avatar_core.cli.bench._run_module", lambda *_: sys.exit("measured"))
    found, _, err = said(command)
    assert found == code and reason in " ".join(err.split())


def test_a_remedy_names_a_fidelity_that_exists() -> None:
    sources = (path.read_text() for path in (ROOT / "avatar_core").rglob("*.py"))
    named = {word for text in sources for word in re.findall(r"--fidelity (\w+)", text)}
    assert named and named <= {*get_args(Fidelity)}
