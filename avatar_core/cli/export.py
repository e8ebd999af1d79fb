"""``avatar export``: a vademecum for ParaView or 3D Slicer, or a recording as MCAP."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from avatar_core.cli.numbers import numbers
from avatar_core.cli.output import Replace, require_output
from avatar_core.cli.unused import refuse
from avatar_core.cli.vademecum import require

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum


def export(
    ctx: typer.Context,
    file: Annotated[
        Path, typer.Argument(help="vademecum, or recording of the planning page (.h5)")
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help="file to write: .vtu or .xdmf, the organ at rest with displacement and modes; "
            ".stl, .obj or .vtp, the deformed surface, and structures in files of their own; "
            ".mcap, a recording as a bag of ROS 2",
        ),
    ],
    at: Annotated[
        str | None,
        typer.Option(
            help="point of the load [m], e.g. 0,0.07,0.005; default: middle of the "
            "accessible surface"
        ),
    ] = None,
    force: Annotated[
        str,
        typer.Option(
            help="load [N]: one number, inward along the normal, or a vector, e.g. 0,-1,0.5"
        ),
    ] = "1",
    modes: Annotated[int, typer.Option(help="number of global modes to write")] = 10,
    unit: Annotated[str, typer.Option(help="unit of surfaces: mm, cm or m")] = "mm",
    axes: Annotated[
        str, typer.Option(help="axes of surfaces: LPS or RAS, stated in the file's header")
    ] = "LPS",
    overwrite: Replace = False,
) -> None:
    """Export an organ for ParaView or 3D Slicer.

    The organ is under a load. The suffix of the output chooses a mesh (ParaView) or deformed
    surfaces (3D Slicer). A recording is exported as MCAP, a bag of ROS 2.
    """
    from avatar_core.bags.files import MCAP
    from avatar_core.contact.tool_path import middle_of_access
    from avatar_core.geometry.surface import METRES
    from avatar_core.scene.export import DISPLACEMENT, FORMATS, organ_mesh, write_mesh
    from avatar_core.scene.surface_export import (
        AXES,
        SURFACE_FORMATS,
        displaced,
        parts_of,
        write_surfaces,
    )
    from avatar_core.vademecum.storage import load_vademecum

    require(modes >= 0, f"--modes is {modes}; ask for 0 or more")
    require(unit in METRES, f"--unit is {unit}; choose {', '.join(METRES)}")
    require(axes in AXES, f"--axes is {axes}; choose {' or '.join(AXES)}")
    suffixes = [*FORMATS, *SURFACE_FORMATS, MCAP]
    require_output(output, suffixes, [file], overwrite=overwrite)
    if output.suffix == MCAP:
        use = f"for a vademecum, and {MCAP} is for a recording"
        refuse(ctx, ("at", "force", "modes", "unit", "axes"), use)
    elif output.suffix in FORMATS:
        refuse(ctx, ("unit", "axes"), f"for surfaces, and {output.suffix} is in m and RAS")
    else:
        refuse(ctx, ("modes",), f"for {' and '.join(FORMATS)}")
    if output.suffix == MCAP:
        _export_recording(file, output)
        return
    newtons = numbers("--force", force, (1, 3), "one number or three, e.g. 0,-1,0.5")
    given = None if at is None else numbers("--at", at, (3,), "three numbers, e.g. 0,0.07,0.005")
    vademecum = load_vademecum(file)
    point = vademecum.surface.centers[middle_of_access(vademecum)] if given is None else given
    if output.suffix in FORMATS:
        mesh = organ_mesh(vademecum, point, newtons, modes)
        displacement = mesh.point_data[DISPLACEMENT]
        write_mesh(mesh, output)
        n_modes = sum(name.startswith("mode_") for name in mesh.point_data)
        print(f"{output}: {len(mesh.points)} vertices, {n_modes} modes, at rest, in m and RAS")
    else:
        displacement = vademecum.displacement_at(point, newtons)
        for path in parts_of(vademecum, output):
            require_output(path, suffixes, [file], overwrite=overwrite)
        points = displaced(vademecum, displacement)
        written = write_surfaces(vademecum, output, points, unit, axes)
        for path, (vertices, _) in written.items():
            print(f"{path}: {len(vertices)} vertices, deformed, in {unit} and {axes}")
    _say_load(vademecum, point, newtons, float((displacement**2).sum(axis=1).max() ** 0.5))


def _export_recording(file: Path, output: Path) -> None:
    from avatar_core.bags.write import write_mcap
    from avatar_core.scene.recording import load_recording

    recording = load_recording(file)
    write_mcap(recording, output)
    n_clouds = len(recording.clouds.period)
    without = f", without {n_clouds} clouds" if n_clouds else ""
    print(f"{output}: {len(recording.periods)} periods in {recording.seconds:.1f} s{without}")


def _say_load(vademecum: Vademecum, point: Any, newtons: list[float], moved: float) -> None:
    """Print the load, the largest displacement [m], and its known error."""
    from avatar_core.geometry.tip import MAX_DEPTH

    place = vademecum.surface.nearest(point)
    x, y, z = place.point
    newton = sum(number * number for number in newtons) ** 0.5
    certificate = vademecum.certificate
    known = f", {certificate.l2_mean:.1%} mean error" if certificate else ", of unknown error"
    print(
        f"{newton:g} N at ({x:.4f}, {y:.4f}, {z:.4f}) m move it by {1e3 * moved:.2f} mm at "
        f"most{known}"
    )
    pressing = newtons[0] if len(newtons) == 1 else -float(place.normal @ newtons)
    push = vademecum.push(place.positions, place.weights, max(pressing, 0.0))
    if not push.within:
        print("warning: a deeper push than was computed; extrapolated", file=sys.stderr)
    elif moved > MAX_DEPTH:
        print(
            f"warning: farther than the {1e3 * MAX_DEPTH:g} mm up to which contact is covered, and "
            "than small strains allow; press with less force",
            file=sys.stderr,
        )
