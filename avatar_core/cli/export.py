"""``avatar export``: a vademecum as a mesh that ParaView opens."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from avatar_core.cli.output import require_output
from avatar_core.cli.vademecum import require


def export(
    file: Annotated[Path, typer.Argument(help="vademecum to export (.h5)")],
    output: Annotated[Path, typer.Option("-o", "--output", help="mesh to write (.vtu or .xdmf)")],
    at: Annotated[
        str | None,
        typer.Option(
            help="point of the load [m], such as 0,0.07,0.005; default: middle of the accessible "
            "surface"
        ),
    ] = None,
    force: Annotated[
        str,
        typer.Option(
            help="load [N]: one number, inward along the normal, or a vector such as 0,-1,0.5"
        ),
    ] = "1",
    modes: Annotated[int, typer.Option(help="number of global modes to write")] = 10,
) -> None:
    """Export an organ for ParaView: at rest, with its first modes and its displacement."""
    from avatar_core.contact.tool_path import middle_of_access
    from avatar_core.scene.export import FORMATS
    from avatar_core.scene.export import export as exported
    from avatar_core.vademecum.storage import load_vademecum

    require(modes >= 0, f"--modes is {modes}; ask for 0 or more")
    require_output(output, FORMATS, [file])
    newtons = _numbers("--force", force, (1, 3), "one number or three, as 0,-1,0.5")
    given = None if at is None else _numbers("--at", at, (3,), "three numbers, as 0,0.07,0.005")
    vademecum = load_vademecum(file)
    point = vademecum.surface.centers[middle_of_access(vademecum)] if given is None else given
    mesh = exported(vademecum, output, point, newtons, modes)
    moved = ((mesh.point_data["displacement"] ** 2).sum(axis=1) ** 0.5).max()
    x, y, z = vademecum.surface.nearest(point).point
    n_modes = sum(name.startswith("mode_") for name in mesh.point_data)
    newton = sum(number * number for number in newtons) ** 0.5
    print(
        f"{output}: {len(mesh.points)} vertices, {n_modes} modes; "
        f"{newton:g} N at ({x:.4f}, {y:.4f}, {z:.4f}) m move it by {1e3 * moved:.2f} mm at most"
    )


def _numbers(option: str, text: str, counts: tuple[int, ...], remedy: str) -> list[float]:
    """The numbers of an option, separated by commas.

    Raises AvatarError, with the remedy, unless there are as many as one of the counts.
    """
    try:
        numbers = [float(number) for number in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    require(len(numbers) in counts, f"{option} is '{text}'; give {remedy}")
    return numbers
