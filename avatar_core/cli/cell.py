"""``avatar cell``: the nodes of a planning cell, without the launch package."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from avatar_core.cli.bench import require_ros
from avatar_core.cli.vademecum import require
from avatar_core.common.processes import ModuleProcess
from avatar_core.errors import AvatarError

_AGAIN = 1.0  # after which a cell that has not ended is interrupted again [s]

_HOST = "network address of the page; 0.0.0.0: all interfaces, without TLS"
_PORT = "port of the page; if it is taken, the next free port"
Host = Annotated[str, typer.Option(help=_HOST)]
Port = Annotated[int, typer.Option(help=_PORT)]


def cell(
    params: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="parameters of all nodes (YAML), e.g. params/planning_cell.yaml",
        ),
    ] = None,
    library_dir: Annotated[
        Path | None, typer.Option(exists=True, file_okay=False, help="folder of the vademecums")
    ] = None,
    vademecum: Annotated[str, typer.Option(help="vademecum to load, a file in --library-dir")] = "",
    atlas: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            file_okay=False,
            help="folder of the atlas, for the node that builds patients",
        ),
    ] = None,
    tools: Annotated[
        str, typer.Option(help="names of the tools, e.g. left,right; default: one tool, named tool")
    ] = "",
    scene: Annotated[
        str,
        typer.Option(
            help="scene to simulate, with as many tools as --tools: name of a "
            "shipped scene, or a path"
        ),
    ] = "",
    state_dir: Annotated[
        Path | None,
        typer.Option(
            file_okay=False,
            help="folder in which nodes keep their state over restarts; default: none is kept",
        ),
    ] = None,
    ui: Annotated[bool, typer.Option("--ui", help="also serve the planning page")] = False,
    host: Annotated[
        str | None, typer.Option(help=f"{_HOST}; default: the parameter file's, or 127.0.0.1")
    ] = None,
    port: Annotated[
        int | None, typer.Option(help=f"{_PORT}; default: the parameter file's, or 8080")
    ] = None,
) -> None:
    """Run the nodes of a planning cell.

    The loader, the contact node and, with an atlas, the patient node run until Ctrl-C. Options
    override the parameter file. Without both, the library is the current folder. A node that dies
    is started again. A node that refuses to start, or is told to end, ends all. In other respects
    the command equals `ros2 launch avatar_ros planning_cell.launch.py`.
    """
    require(
        ui or (host is None and port is None),
        "--host and --port are for the planning page; add --ui, or leave them out",
    )
    require_ros()
    given = {
        "params": params and params.resolve(),
        "library_dir": _library(library_dir, params),
        "vademecum": vademecum,
        "atlas": atlas and atlas.resolve(),
        "tools": tools,
        "scene": Path(scene).resolve() if Path(scene).is_file() else scene,
        "state_dir": state_dir and state_dir.resolve(),
        "host": host,
        "port": port,
    }
    command = [sys.executable, "-m", "avatar_ros.nodes.cell"]
    for name, value in given.items():
        command += [f"--{name}", str(value)] if value not in (None, "") else []
    if ui:
        require_ui()
        command.append("--ui")
    sys.stdout.flush()
    os.chdir("/")  # -m would let a checkout here stand before what is installed
    os.execv(sys.executable, command)  # signals are for the cell


def _library(given: Path | None, params: Path | None) -> Path | None:
    """Return the folder of the vademecums; nodes start in another one."""
    if given is None and params is None:
        return Path.cwd()
    return given and given.resolve()


def require_ui() -> None:
    """Raise AvatarError if the planning page cannot be served."""
    if find_spec("viser") is None:
        raise AvatarError("the planning page needs viser; install it with pip install '.[ui]'")


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def run_page(vademecum: Path, host: str, port: int) -> None:
    """Serve the planning page with the cell that it shows, until Ctrl-C."""
    given = {
        "library_dir": str(vademecum.parent),
        "vademecum": vademecum.name,
        "host": host,
        "port": str(port),
    }
    options = [word for name, value in given.items() for word in (f"--{name}", value)]
    sys.stdout.flush()
    told = False
    # Deaf until it listens for itself: half started, it would end with a traceback.
    with ModuleProcess(
        "avatar_ros.nodes.cell",
        "--ui",
        *options,
        start_new_session=False,
        preexec_fn=_ignore_interrupts,
    ) as process:
        while process.poll() is None:
            try:
                if told:  # a terminal told it as well; told twice, it ends once
                    process.send_signal(signal.SIGINT)
                with suppress(subprocess.TimeoutExpired):
                    process.wait(_AGAIN)
            except KeyboardInterrupt:
                told = True
    if process.returncode != 0:
        raise typer.Exit(process.returncode)
