"""``avatar calibrate``: the material of an organ from the forces of some touches."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from avatar_core.cli.bench import require_ros
from avatar_core.cli.numbers import ToolTransform, pose_of
from avatar_core.cli.output import Replace, require_output
from avatar_core.cli.progress import progress_bar
from avatar_core.cli.uncertainty import given_of
from avatar_core.cli.unused import refuse
from avatar_core.cli.vademecum import File, require, say_notices
from avatar_core.common.dataclass_json import plain

if TYPE_CHECKING:
    from avatar_core.uncertainty.calibration import Calibration

EXIT_NOT_EXPLAINED = 3
_FORMATS = (".yaml", ".json", ".png", ".pdf", ".svg")


def calibrate(
    ctx: typer.Context,
    file: File,
    recording: Annotated[
        Path,
        typer.Option(
            help="touches with measured forces: a recording of the planning page (.h5), or a bag "
            "of ROS 2 with measured_cp and measured_cf of a tool"
        ),
    ],
    given: Annotated[
        list[str] | None,
        typer.Option(
            help="prior knowledge of a parameter, as in 'avatar uncertainty', e.g. "
            "young=lognormal:5300:1.5; may be repeated; default: anything within the "
            "ranges of the vademecum, and a Young's modulus of 500 to 350,000 Pa"
        ),
    ] = None,
    tool: Annotated[
        str | None,
        typer.Option(
            help="for a bag of several tools: NAME in the topics NAME/measured_cp; for a "
            "recording: number of the tool, from 1"
        ),
    ] = None,
    tool_transform: ToolTransform = None,
    radius: Annotated[
        float, typer.Option(help="for a bag: radius of the spherical tip [mm]")
    ] = 5.0,
    sensor: Annotated[
        float, typer.Option(help="standard deviation of a measured force over the force [-]")
    ] = 0.02,
    least: Annotated[
        float, typer.Option(help="smallest standard deviation of a measured force [N]")
    ] = 0.02,
    depth: Annotated[
        float,
        typer.Option(
            help="standard deviation of the surface's place at a touch [mm], by the mesh and "
            "the registration of tool and organ"
        ),
    ] = 0.3,
    extent: Annotated[
        float,
        typer.Option(
            help="relative standard deviation of contrast and support stiffness [-], because "
            "the mesh changes the extent of a tumour or support"
        ),
    ] = 0.2,
    output: Annotated[
        list[Path] | None,
        typer.Option(
            "-o",
            "--output",
            help="write distributions for 'avatar uncertainty' (.yaml), all numbers (.json) or a "
            "picture (.png, .pdf, .svg); may be repeated",
        ),
    ] = None,
    set_them: Annotated[
        bool, typer.Option("--set", help="set the values in the running contact node")
    ] = False,
    overwrite: Replace = False,
) -> None:
    """Find material values from measured forces.

    The forces are those of some touches. The values are Young's modulus and the coordinates of a
    vademecum.
    """
    from avatar_core.bags.files import is_bag
    from avatar_core.bags.touched import TouchFile, palpated, read_touched
    from avatar_core.uncertainty.calibration import TouchErrors, calibrated, touch_table
    from avatar_core.uncertainty.calibration_report import say
    from avatar_core.uncertainty.known import priors_of
    from avatar_core.vademecum.storage import load_vademecum

    if not is_bag(recording):
        use = "for bags, and this is a recording of the page, which holds its tools"
        refuse(ctx, ("tool_transform", "radius"), use)
    for one in output or []:
        require_output(one, _FORMATS, [file, recording, *(given or [])], overwrite=overwrite)
    require(0.0 < sensor < 1.0, f"--sensor is {sensor}; give a fraction of the force, e.g. 0.02")
    require(1.0 <= radius <= 20.0, f"--radius is {radius:g} mm; give 1 to 20")
    require(least > 0.0, f"--least is {least} N; give a positive force")
    require(0.0 <= depth <= 20.0, f"--depth is {depth} mm; give 0 to 20")
    require(0.0 <= extent <= 1.0, f"--extent is {extent}; give a fraction of the value, 0 to 1")
    if set_them:
        require_ros()
    known = given_of(given or [])
    transform = pose_of(tool_transform)
    with progress_bar("messages") as progress:
        touched = read_touched(TouchFile(recording, tool, transform, 1e-3 * radius), progress)
    vademecum = load_vademecum(file)
    priors = priors_of(vademecum, known)
    errors = TouchErrors(sensor, least, 1e-3 * depth, extent=extent)
    palpation, errors, notes = palpated(vademecum, touched, errors)
    with progress_bar("materials") as progress:
        table = touch_table(vademecum, touched.tip, palpation, progress)
    found = calibrated(table, priors, errors)
    say_notices((*notes, *found.notices))
    say(vademecum.name, table, found)
    for one in output or []:
        _write(one, vademecum.name, table, found)
    if not found.explained:
        raise typer.Exit(EXIT_NOT_EXPLAINED)
    if set_them:
        _set(found)


def _write(output: Path, name: str, table: object, found: Calibration) -> None:
    from avatar_core.uncertainty import calibration_report as report
    from avatar_core.uncertainty.calibration import TouchTable

    assert isinstance(table, TouchTable)
    if output.suffix == ".yaml":
        output.write_text(report.distributions_text(name, found))
    elif output.suffix == ".json":
        output.write_text(json.dumps(plain(report.numbers(table, found)), indent=1) + "\n")
    else:
        report.picture(output, name, table, found)
    print(output)


def _set(found: Calibration) -> None:
    """Set the values in the running contact node; its answer is printed by the module."""
    values = [f"{name}={found.value(name):.6g}" for name in found.names]
    sys.stdout.flush()
    command = [sys.executable, "-m", "avatar_ros.nodes.set_material", *values]
    done = subprocess.run(command, cwd="/", check=False)
    if done.returncode != 0:
        raise typer.Exit(done.returncode)
