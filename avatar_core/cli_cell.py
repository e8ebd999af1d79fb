"""``avatar cell``: the nodes of a planning cell, without the launch package."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from avatar_core.cli_bench import require_ros


def cell(
    params: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="YAML for all nodes, as params/planning_cell.yaml"
        ),
    ] = None,
    library_dir: Annotated[
        Path | None, typer.Option(exists=True, file_okay=False, help="of the vademecums")
    ] = None,
    vademecum: Annotated[str, typer.Option(help="file in it to load")] = "",
    atlas: Annotated[
        Path | None,
        typer.Option(exists=True, dir_okay=False, help="for the node that makes patients"),
    ] = None,
    scene: Annotated[str, typer.Option(help="effects to simulate")] = "",
) -> None:
    """Run loader, contact node and, with an atlas, the node that makes patients, until Ctrl-C.

    Options go before what the file says. Does what `ros2 launch avatar_ros
    planning_cell.launch.py` does; all end when one of them does.
    """
    require_ros()
    given = {
        "params": params and params.resolve(),
        "library_dir": library_dir and library_dir.resolve(),
        "vademecum": vademecum,
        "atlas": atlas and atlas.resolve(),
        "scene": scene,
    }
    command = [sys.executable, "-m", "avatar_ros.cell"]
    for name, value in given.items():
        command += [f"--{name}", str(value)] if value else []
    sys.stdout.flush()
    os.chdir("/")  # -m would let a checkout here stand before what is installed
    os.execv(sys.executable, command)  # signals are for the cell
