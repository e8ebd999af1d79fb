"""`avatar cell`: all nodes from one file, which end together."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from avatar_ros.bench.footprint import children
from avatar_ros.framework import qos
from avatar_ros.nodes.cell import node_arguments, wait_after

from avatar_core.cli.cell import cell
from avatar_ros.msg import ContactState
from tests.helpers.slowness import end_of, wait_until
from tests.ros.conftest import START_TIMEOUT
from tests.ros.helpers.doc_pages import ROOT


@contextmanager
def started(arguments: list[str], domain: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    command = [
        sys.executable,
        "-c",
        "from avatar_core.cli.main import main; raise SystemExit(main())",
    ]
    process = subprocess.Popen(
        [*command, "cell", *arguments], cwd="/", env=domain, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long)]
)
def test_one_file_of_parameters_starts_a_cell_that_a_signal_ends(
    own_domain: dict[str, str], library: Path, tmp_path: Path, probe: Any, number: int
) -> None:
    file = tmp_path / "cell.yaml"
    text = (ROOT / "params" / "planning_cell.yaml").read_text()
    text = text.replace("library_dir: . # nothing", f"library_dir: {library} # nothing")
    text = text.replace('vademecum: "" # file', "vademecum: liver.h5 # file")
    file.write_text(text)
    with started(["--params", str(file)], own_domain) as process:
        probe.next(
            ContactState, "contact_state", qos.state(1), lambda s: s.vademecum_id, START_TIMEOUT
        )
        begin = time.monotonic()
        process.send_signal(number)
        assert end_of(process, 15.0) == 0
        print(f"ended in {time.monotonic() - begin:.1f} s")


def child(process: subprocess.Popen[str], node: str) -> int | None:
    """Number of the cell's process of a node."""
    for number in children(process.pid):
        if f"avatar_ros.nodes.{node}".encode() in Path(f"/proc/{number}/cmdline").read_bytes():
            return number
    return None


@pytest.mark.long
def test_a_node_that_dies_is_started_again_and_named(
    own_domain: dict[str, str], library: Path, probe: Any
) -> None:
    def model() -> None:
        """Wait for a step of the contact node with the model."""
        probe.next(
            ContactState, "contact_state", qos.state(1), lambda s: s.vademecum_id, START_TIMEOUT
        )

    arguments = ["--library-dir", str(library), "--vademecum", "liver.h5"]
    with started(arguments, own_domain) as process:
        model()
        killed = child(process, "contact")
        assert killed is not None
        os.kill(killed, signal.SIGKILL)
        wait_until(lambda: not Path(f"/proc/{killed}").exists(), 10.0, "the cell did not notice")
        model()
        assert child(process, "contact") not in (None, killed)
        process.send_signal(signal.SIGINT)
        assert end_of(process, 15.0) == 0
        assert process.stderr is not None
        said = process.stderr.read()
    assert "contact died of SIGKILL; starting it again" in said
    assert "vademecum_loader" not in said.replace("[vademecum_loader]", "")


def test_a_node_that_dies_again_and_again_is_given_time() -> None:
    assert [wait_after(deaths) for deaths in range(1, 9)] == [0, 1, 2, 4, 8, 16, 30, 30]


def test_a_node_that_refuses_to_start_ends_the_cell_and_is_named(
    own_domain: dict[str, str], tmp_path: Path
) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text("contact:\n  ros__parameters: {rate: 5.0}\n")
    with started(["--params", str(file)], own_domain) as process:
        assert end_of(process, START_TIMEOUT) == 1
        assert process.stderr is not None
        said = process.stderr.read()
    assert "contact ended with code 1; ending the cell" in said
    assert "parameter rate" in said


def test_page_and_patients_run_only_if_asked_for() -> None:
    always = {"vademecum_loader", "contact"}
    assert set(node_arguments(None, {})) == always
    assert set(node_arguments(None, {"atlas": "atlas.h5"})) == {*always, "patient_interpolation"}
    kept = node_arguments(None, {"state_dir": "/kept"})
    assert all(kept[node][-1] == "state_dir:=/kept" for node in always)
    both = node_arguments(None, {"tools": "left,right"})
    assert both["contact"][-1] == "tools:=[left,right]" and both["vademecum_loader"] == []
    page = node_arguments(None, {"ui": "yes", "port": "8081"})
    assert set(page) == {*always, "planning_ui"}
    assert page["planning_ui"][-1] == "port:=8081"


def test_paths_are_those_of_where_it_was_called(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Nodes start in another folder."""
    (tmp_path / "drag.yaml").write_text("")
    ran: list[list[str]] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "execv", lambda _, command: ran.append(command))
    cell(scene="drag.yaml")
    os.chdir(tmp_path)
    cell(scene="palpation", params=tmp_path / "p.yaml", tools="left,right")
    by_file, by_name = (" ".join(command[3:]) for command in ran)
    assert by_file == f"--library_dir {tmp_path} --scene {tmp_path / 'drag.yaml'}"
    assert by_name == f"--params {tmp_path / 'p.yaml'} --tools left,right --scene palpation"
