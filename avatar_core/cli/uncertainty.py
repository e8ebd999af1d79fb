"""``avatar uncertainty``: bands of force and displacement when the data are not known exactly."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from avatar_core.cli.numbers import numbers
from avatar_core.cli.output import Replace, require_output
from avatar_core.cli.progress import progress_bar
from avatar_core.cli.vademecum import File, require, say_notices

if TYPE_CHECKING:
    from avatar_core.uncertainty.distributions import Distribution
    from avatar_core.vademecum.model import Vademecum

_FORMATS = (".json", ".png", ".pdf", ".svg")
_DEPTHS = "1,2,4,6,8"


def uncertainty(
    file: File,
    given: Annotated[
        list[str],
        typer.Option(
            help="distribution of a parameter: NAME=lognormal:MEDIAN:FACTOR, "
            "uniform:LOW:HIGH, loguniform:LOW:HIGH or fixed:VALUE, where NAME is young "
            "[Pa] or a coordinate of the vademecum. Or a file of distributions (.yaml), "
            "e.g. params/uncertainty/liver.yaml. May be repeated. Other parameters keep "
            "the vademecum's value"
        ),
    ],
    draws: Annotated[int, typer.Option(help="number of draws")] = 1000,
    at: Annotated[
        list[str] | None,
        typer.Option(
            help="place that is pressed [m], e.g. 0,0.07,0.005; may be repeated; default: "
            "three places far apart"
        ),
    ] = None,
    depths: Annotated[str, typer.Option(help="depths of the tip [mm]")] = _DEPTHS,
    radius: Annotated[float, typer.Option(help="radius of the spherical tip [mm]")] = 5.0,
    target: Annotated[
        str | None,
        typer.Option(
            help="point whose displacement is asked for [m]; default: the tumour, or the middle of "
            "the organ"
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="write numbers (.json) or a picture")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="seed of the draws")] = 0,
    overwrite: Replace = False,
) -> None:
    """Show bands of force and displacement.

    The data are known as distributions only. The output also names parameters that make the
    bands wide.
    """
    from avatar_core.geometry.tip import Tip
    from avatar_core.uncertainty.bands import force_bands
    from avatar_core.uncertainty.known import known_of
    from avatar_core.uncertainty.report import picture, rows, say
    from avatar_core.vademecum.storage import load_vademecum

    require(20 <= draws <= 1_000_000, f"--draws is {draws}; give 20 to 1,000,000")
    if output is not None:
        require_output(output, _FORMATS, [file, *given], overwrite=overwrite)
    require(1.0 <= radius <= 20.0, f"--radius is {radius:g} mm; give 1 to 20")
    pressed = _depths(depths)
    tip = Tip("sphere", 1e-3 * radius)
    known = given_of(given)
    vademecum = load_vademecum(file)
    known = known_of(vademecum, known)
    points = _points(vademecum, at)
    wanted = "three numbers, e.g. 0,0.05,0"
    aim = None if target is None else numbers("--target", target, (3,), wanted)
    with progress_bar("materials") as show:
        bands = force_bands(vademecum, known, points, pressed, tip, aim, draws, seed, show)
    say_notices(bands.notices)
    say(vademecum.name, draws, known, pressed, bands)
    if output is not None and output.suffix == ".json":
        output.write_text(json.dumps(rows(pressed, bands), indent=1) + "\n")
    elif output is not None:
        picture(output, vademecum.name, known, pressed, bands)
    if output is not None:
        print(output)


def given_of(given: list[str]) -> dict[str, Distribution]:
    """Return the distributions of options ``--given``."""
    from avatar_core.uncertainty.distributions import parse, read_distributions

    found: dict[str, Distribution] = {}
    for one in given:
        if "=" in one:
            found |= [parse(one)]
        else:
            found |= read_distributions(Path(one))
    return found


def _depths(text: str) -> list[float]:
    import numpy as np

    from avatar_core.geometry.tip import MAX_DEPTH

    counts, most = tuple(range(1, 101)), 1e3 * MAX_DEPTH
    found = numbers("--depths", text, counts, f"rising numbers [mm], e.g. {_DEPTHS}")
    fits = found[0] > 0.0 and found[-1] <= most and (np.diff(found) > 0.0).all()
    require(bool(fits), f"--depths is {text}; give rising numbers above 0, up to {most:g} mm")
    return [1e-3 * depth for depth in found]


def _points(vademecum: Vademecum, at: list[str] | None) -> list[list[float]]:
    """Return the places where the tip presses [m]."""
    from avatar_core.contact.tool_path import starts_apart

    if not at:
        return vademecum.surface.centers[starts_apart(vademecum, 3)].tolist()
    return [numbers("--at", text, (3,), "three numbers, e.g. 0,0.07,0.005") for text in at]
