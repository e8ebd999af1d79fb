"""``avatar register``: an organ at a cloud of points, with the uncertainty of its displacement."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from avatar_core.cli.numbers import numbers
from avatar_core.cli.output import Replace, require_output
from avatar_core.cli.unused import refuse
from avatar_core.cli.vademecum import AsJson, Axes, File, Unit, parsed_axes, require, say_notices
from avatar_core.common.dataclass_json import plain
from avatar_core.geometry.surface_formats import MESH_NAMES

if TYPE_CHECKING:
    from avatar_core.registration.register import Estimate, Registered
    from avatar_core.vademecum.model import Vademecum

EXIT_NOT_EXPLAINED = 3
EXIT_NOT_DETERMINED = 4
FRAMES = ("camera", "known")
KINDS = ("smooth", "few", "pressure")
LARGE = 0.01  # displacement from which small strains are spoken of [m]
HELP = (
    "a known frame (--frame known), the place where the tool presses (--forces near) or a "
    "second view would help"
)


def register(
    ctx: typer.Context,
    file: File,
    points: Annotated[
        Path,
        typer.Option(
            help=f"points on the deformed surface, in any order: {MESH_NAMES}, or x, y, z in each "
            "line of .xyz, .csv, .txt; aligned to about 10 mm and 10 degrees"
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help="file to write: .vtp, .stl or .obj, the deformed surface (mm, LPS), and "
            "structures in files of their own; .vtu or .xdmf, the deformed organ (m, RAS)",
        ),
    ],
    unit: Unit = "mm",
    axes: Axes = None,
    noise: Annotated[
        float,
        typer.Option(help="approximate standard deviation of the points along the normal [m]"),
    ] = 1e-3,
    correlation: Annotated[
        float,
        typer.Option(
            help="length over which errors of the points are correlated [m], "
            "e.g. of a stereo camera; 0: not correlated"
        ),
    ] = 0.0,
    frame: Annotated[
        str,
        typer.Option(
            help="camera: the organ may have moved rigidly, by about --shift and --turn; "
            "known: the organ only deformed, and the cloud is in its frame"
        ),
    ] = "camera",
    shift: Annotated[float, typer.Option(help="root mean square of a rigid shift [m]")] = 0.01,
    turn: Annotated[float, typer.Option(help="root mean square of a rigid turn [degrees]")] = 10.0,
    support_shift: Annotated[
        float, typer.Option(help="approximate motion of each support of the vademecum [m]")
    ] = 0.0,
    kind: Annotated[
        str | None,
        typer.Option(
            help="kind of loads that deformed the organ: smooth (tractions all over), few "
            "(forces at up to three places, e.g. by tools) or pressure; default: smooth "
            "or few, whichever better predicts patches left out of the cloud"
        ),
    ] = None,
    forces: Annotated[
        str,
        typer.Option(
            help="places where forces may act: accessible, seen, or near X,Y,Z,RADIUS at "
            "rest [m], e.g. for a tracked tool"
        ),
    ] = "accessible",
    within: Annotated[
        float,
        typer.Option(
            help="largest half-width [m] of a place's 90 % interval that counts as determined"
        ),
    ] = 5e-3,
    at: Annotated[
        str | None,
        typer.Option(
            help="target in the organ at rest [m], e.g. 0,0.07,0.005; default: its tumours, "
            "or else the vertex that moves most"
        ),
    ] = None,
    as_json: AsJson = False,
    overwrite: Replace = False,
) -> None:
    """Register an organ to points on its surface.

    The organ is brought to a cloud of points on its deformed surface. The output tells where its
    tumour is. Exit code 3: the model does not explain the cloud, and nothing is written. Exit code
    4: written, but the unseen part, or a target, is not determined.
    """
    from avatar_core.registration.cloud import read_cloud
    from avatar_core.registration.register import register as registered_to
    from avatar_core.registration.rule import RegistrationRule
    from avatar_core.scene.export import FORMATS
    from avatar_core.scene.surface_export import SURFACE_FORMATS, parts_of
    from avatar_core.vademecum.storage import load_vademecum

    suffixes = [*SURFACE_FORMATS, *FORMATS]
    require_output(output, suffixes, [file, points], overwrite=overwrite)
    require(frame in FRAMES, f"--frame is {frame}; choose {' or '.join(FRAMES)}")
    require(kind is None or kind in KINDS, f"--kind is {kind}; choose {', '.join(KINDS)}")
    known = frame == "known"
    if known:
        refuse(ctx, ("shift", "turn"), "for --frame camera: in a known frame nothing moves rigidly")
    rule = RegistrationRule(
        noise=noise,
        turn=0.0 if known else math.radians(turn),
        shift=0.0 if known else shift,
        support_shift=support_shift,
        kind=kind,  # type: ignore[arg-type]
        forces=forces.replace(",", " "),
        correlation=correlation,
        within=within,
    )
    target = None if at is None else numbers("--at", at, (3,), "three numbers, e.g. 0,0.07,0.005")
    cloud = read_cloud(points, unit, parsed_axes(axes))
    say_notices(cloud.notices)
    vademecum = load_vademecum(file)
    for path in parts_of(vademecum, output) if output.suffix in SURFACE_FORMATS else ():
        require_output(path, suffixes, [file, points], overwrite=overwrite)
    found = registered_to(vademecum, cloud, rule)
    say_notices(tuple(line for line in found.notices if line not in cloud.notices))
    given = [] if target is None else [found.target_at(target)]
    estimates = given or found.targets() or [found.largest()]
    largest_move = float(abs(found.displacement).max())
    if largest_move > LARGE and not found.problems:
        said = f"notice: displaced by up to {1e3 * largest_move:.0f} mm: small strains leave out "
        print(f"{said}some {found.model_error:.0%}, which is in the intervals", file=sys.stderr)
    missing = found.undetermined(estimates)
    if as_json:
        print(json.dumps(plain(_summary(found, estimates)), indent=2))
    if found.problems:  # no place is told, nor written
        print(_verdict(found, missing), file=sys.stderr if as_json else sys.stdout)
        raise typer.Exit(EXIT_NOT_EXPLAINED)
    _write(vademecum, found, output)
    if not as_json:
        print("; ".join([*map(_sentence, estimates), _verdict(found, missing)]))
    if missing:
        raise typer.Exit(EXIT_NOT_DETERMINED)


def _sentence(one: Estimate) -> str:
    """Return the displacement of a target with its standard deviation, and its place."""
    import numpy as np

    size = 1e3 * float(np.linalg.norm(one.displacement))
    deviation, off = (
        1e3 * float(np.linalg.norm(each))
        for each in (one.displacement_deviation, one.place_deviation)
    )
    x, y, z = 1e3 * one.place
    return (
        f"{one.name}: displaced by {size:.1f} +- {deviation:.1f} mm, now at ({x:.1f}, {y:.1f}, "
        f"{z:.1f}) +- {off:.1f} mm"
    )


def _verdict(found: Registered, missing: Sequence[str]) -> str:
    """Return residual, rigid motion, and whether the fit explains and determines."""
    import numpy as np

    motion = found.motion
    shift = 1e3 * float(np.linalg.norm(motion.shift))
    fit = "the fit is good"
    if found.problems:
        fit = f"NOT EXPLAINED: {', '.join(found.problems)}; nothing is written"
    elif missing:
        fit = f"NOT DETERMINED: {', '.join(missing)}; {HELP}"
    loads = {"few": f"{found.fit.loads.size // 3} force(s)"}.get(found.fit.kind, found.fit.kind)
    return (
        f"residual {1e3 * found.rms:.2f} mm rms by {loads}; rigid motion {shift:.1f} mm, "
        f"{motion.angle:.1f} degrees; {fit}"
    )


def _write(vademecum: Vademecum, found: Registered, output: Path) -> None:
    import meshio
    import numpy as np

    from avatar_core.scene.export import DISPLACEMENT, FORMATS, write_mesh
    from avatar_core.scene.surface_export import carried, displaced, write_surfaces

    fields = {
        DISPLACEMENT: found.displacement,
        "standard deviation of displacement [m]": np.linalg.norm(
            found.displacement_deviation, axis=1
        ),
        "standard deviation of place [m]": np.linalg.norm(found.place_deviation, axis=1),
        "half of the 90 % interval of place [m]": found.interval,
        "decided by the cloud [-]": found.by_data,
    }
    if output.suffix in FORMATS:
        cells = [("tetra", vademecum.mesh.tets)]
        write_mesh(meshio.Mesh(found.place, cells, point_data=fields), output)
        return
    place = found.motion(displaced(vademecum, found.displacement))
    shown = {name: carried(vademecum, value) for name, value in fields.items()}
    write_surfaces(vademecum, output, place, fields=shown)


def _summary(found: Registered, estimates: list[Estimate]) -> dict[str, Any]:
    """Return all figures; lengths in m, angles in degrees, forces in N."""
    import numpy as np

    fit = found.fit
    scale, length, noise, mismatch = fit.scales.tolist()
    of_loads = "displacement" if fit.kind == "few" else "traction_pascal"
    return {
        "targets": [asdict(one) for one in estimates],
        "residual_rms": found.rms,
        "rigid_motion": {
            "centre": found.motion.centre,
            "rotation_degrees": np.degrees(found.motion.turn),
            "translation": found.motion.shift,
        },
        "kind": fit.kind,
        "explained": not found.problems,
        "undetermined": list(found.undetermined(estimates)),
        "determined_unseen": float(np.mean(found.is_determined[np.logical_not(found.seen)])),
        "problems": list(found.problems),
        "forces": [asdict(one) for one in found.strongest_forces()],
        "scales": {
            of_loads: scale,
            "traction_length": length,
            "noise": noise,
            "surface_mismatch": mismatch,
        },
        "outlying": fit.outlying,
        "n_points": len(fit.residuals),
        "n_steps": fit.n_steps,
        "model_error": found.model_error,
    }
