"""``avatar register``: an organ where a cloud of points shows it, with what is not known of it."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from avatar_core.cli.numbers import numbers
from avatar_core.cli.output import require_output
from avatar_core.cli.vademecum import AsJson, Axes, File, Unit, parsed_axes, say_notices
from avatar_core.common.dataclass_json import plain
from avatar_core.geometry.surface_formats import MESH_NAMES

if TYPE_CHECKING:
    from avatar_core.registration.register import Estimate, Registered
    from avatar_core.vademecum.model import Vademecum

EXIT_NOT_EXPLAINED = 3


def register(
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
        float, typer.Option(help="standard deviation of the points along the normal, about [m]")
    ] = 1e-3,
    at: Annotated[
        str | None,
        typer.Option(
            help="a target in the organ at rest [m], such as 0,0.07,0.005; default: its tumours, "
            "or else where it is displaced most"
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Bring an organ to a cloud of points on its deformed surface: where is the tumour now?"""
    from avatar_core.registration.cloud import read_cloud
    from avatar_core.registration.fit import RegistrationRule
    from avatar_core.registration.register import register as registered_to
    from avatar_core.registration.register import target_at
    from avatar_core.scene.export import FORMATS
    from avatar_core.scene.surface_export import SURFACE_FORMATS
    from avatar_core.vademecum.storage import load_vademecum

    require_output(output, [*SURFACE_FORMATS, *FORMATS], [file, points])
    rule = RegistrationRule(noise=noise)
    target = None if at is None else numbers("--at", at, (3,), "three numbers, as 0,0.07,0.005")
    cloud = read_cloud(points, unit, parsed_axes(axes))
    say_notices(cloud.notices)
    vademecum = load_vademecum(file)
    found = registered_to(vademecum, cloud, rule)
    given = [] if target is None else [target_at(vademecum, found, target)]  # type: ignore[arg-type]
    estimates = given or _shown(vademecum, found)
    if vademecum.large is not None:
        print("notice: the response is that of small strains", file=sys.stderr)
    if as_json:
        print(json.dumps(plain(_summary(vademecum, found, estimates)), indent=2))
    if found.problems:  # no place is told, nor written
        print(_verdict(found), file=sys.stderr if as_json else sys.stdout)
        raise typer.Exit(EXIT_NOT_EXPLAINED)
    _write(vademecum, found, output)
    if not as_json:
        print("; ".join([*map(_sentence, estimates), _verdict(found)]))


def _shown(vademecum: Vademecum, found: Registered) -> list[Estimate]:
    from avatar_core.registration.register import largest, targets

    return targets(vademecum, found) or [largest(found)]


def _sentence(one: Estimate) -> str:
    """Displacement of a target with the standard deviations, and where it is."""
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


def _verdict(found: Registered) -> str:
    """Residual, rigid motion and whether the model explains the cloud."""
    import numpy as np

    motion = found.motion
    shift = 1e3 * float(np.linalg.norm(motion.shift))
    fit = "the fit is good"
    if found.problems:
        fit = f"NOT EXPLAINED: {', '.join(found.problems)}; nothing is written"
    return (
        f"residual {1e3 * found.rms:.2f} mm rms; rigid motion {shift:.1f} mm, "
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
    }
    if output.suffix in FORMATS:
        cells = [("tetra", vademecum.mesh.tets)]
        write_mesh(meshio.Mesh(found.place, cells, point_data=fields), output)
        return
    place = found.motion(displaced(vademecum, found.displacement))
    shown = {name: carried(vademecum, value) for name, value in fields.items()}
    write_surfaces(vademecum, output, place, fields=shown)


def _summary(vademecum: Vademecum, found: Registered, estimates: list[Estimate]) -> dict[str, Any]:
    """All figures; lengths in m, angles in degrees, forces in N."""
    import numpy as np

    from avatar_core.registration.register import strongest_forces

    fit = found.fit
    traction, length, noise, mismatch = fit.scales.tolist()
    return {
        "targets": [asdict(one) for one in estimates],
        "residual_rms": found.rms,
        "rigid_motion": {
            "centre": found.motion.centre,
            "rotation_degrees": np.degrees(found.motion.turn),
            "translation": found.motion.shift,
        },
        "explained": not found.problems,
        "problems": list(found.problems),
        "forces": [asdict(one) for one in strongest_forces(vademecum, found)],
        "scales": {
            "traction_pascal": traction,
            "traction_length": length,
            "noise": noise,
            "surface_mismatch": mismatch,
        },
        "outlying": fit.outlying,
        "n_points": len(fit.residuals),
        "n_steps": fit.n_steps,
        "model_error": found.model_error,
    }
