"""``avatar vademecum`` and ``avatar show``, and options and output of all commands that build."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from avatar_core.cli.output import Overwrite, require_output, same_file
from avatar_core.cli.progress import build_stages, stage_bar
from avatar_core.cli.show_text import show_text, supported_area
from avatar_core.cli.timings import StageClock, Timings, require_timings, show_timings
from avatar_core.cli.unused import refuse, refuse_for_phantom
from avatar_core.common.dataclass_json import plain
from avatar_core.errors import AvatarError
from avatar_core.geometry.surface_formats import LABEL_MAP_NAMES, LABEL_MAPS, MESH_NAMES

if TYPE_CHECKING:
    from avatar_core.geometry.surface import SurfaceMesh
    from avatar_core.vademecum.model import Vademecum

EXIT_NOT_CONVERGED = 3

File = Annotated[Path, typer.Argument(help="vademecum (.h5)")]
Output = Annotated[Path, typer.Option("-o", "--output", help="vademecum to write (.h5)")]
AsJson = Annotated[bool, typer.Option("--json", help="print as JSON")]
Surface = Annotated[
    str,
    typer.Argument(
        help=f"surface file ({MESH_NAMES}) or label map ({LABEL_MAP_NAMES}, which is DICOM SEG); "
        "'phantom': the built-in liver"
    ),
]
Unit = Annotated[str, typer.Option(help="unit of length in the files: mm, cm or m")]
Axes = Annotated[
    str | None,
    typer.Option(
        help="coordinate axes of the files: RAS, LPS, or the 16 numbers of a 4x4 matrix to "
        "RAS; default: the axes that each header states (3D Slicer writes SPACE=LPS), "
        "else RAS"
    ),
]
Label = Annotated[
    str | None,
    typer.Option(
        help="number or name (.seg.nrrd, .dcm) of the organ in a label map; several, e.g. "
        "1,2,3, are one organ"
    ),
]
Groups = Annotated[
    Path | None,
    typer.Option(
        help=".npz file with points 'clamped' and 'accessible' [m], and of supports by name; "
        "it replaces the rule, or the atlas's template"
    ),
]
Supports = Annotated[
    list[str] | None,
    typer.Option(
        "--support",
        help="springs that hold the organ instead of the clamp, per area [N/m^3], e.g. "
        "bare_area=1e6; bare_area=1e5:1e9 to choose it later (not from an atlas); "
        "bare_area=clamped; or bare_area alone for a guess. Also cava_groove, "
        "falciform, right_triangular, left_triangular and groups of --groups; may be "
        "repeated",
    ),
]
Vertices = Annotated[
    int, typer.Option(help="approximate number of mesh vertices; a surface may need more")
]


def vademecum(
    ctx: typer.Context,
    surface: Surface,
    output: Output,
    unit: Unit = "mm",
    axes: Axes = None,
    label: Label = None,
    vertices: Vertices = 2850,
    young: Annotated[float, typer.Option(help="Young's modulus [Pa]")] = 0.17e6,
    poisson: Annotated[float, typer.Option(help="Poisson's ratio, 0 to below 0.5 [-]")] = 0.48,
    patch_radius: Annotated[
        float | None,
        typer.Option(
            help="radius of the patch through which a tool presses [m]; default: 12 mm, or 1.2 "
            "mesh edges if that is larger"
        ),
    ] = None,
    modes: Annotated[
        int | None,
        typer.Option(
            help="largest number of modes that show the displacement at a place; default: 100"
        ),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(help="target for the mean relative error of displacement [-]; default: 0.006"),
    ] = None,
    groups: Groups = None,
    support: Supports = None,
    resection: Annotated[
        Path | None,
        typer.Option(
            help="file (.json, metres, RAS) of a plane or Bezier surface that cuts the "
            "organ; its opening, 0 to 1, can be changed later"
        ),
    ] = None,
    element: Annotated[
        str | None,
        typer.Option(help="finite element: P1, P2 or Taylor-Hood; default: by Poisson's ratio"),
    ] = None,
    coordinate: Annotated[
        list[str] | None,
        typer.Option(
            help="material property that can be changed later, with its range, e.g. "
            "poisson=0.40:0.49, or contrast=0.5:20 for a tumour; may be repeated"
        ),
    ] = None,
    tumour: Annotated[
        Path | None,
        typer.Option(
            help="file of a tumour, a surface or a label map, in unit and axes of the organ "
            "unless it states its own; default with --tumour-label: the organ's label "
            "map"
        ),
    ] = None,
    tumour_label: Annotated[
        str | None,
        typer.Option(
            help="number or name of the tumour in its label map; in the organ's label map, "
            "the tumour belongs to the organ"
        ),
    ] = None,
    contrast: Annotated[
        float, typer.Option(help="Young's modulus inside the tumour over that outside [-]")
    ] = 1.0,
    material: Annotated[
        str,
        typer.Option(
            help="material: linear, or neo-hookean or st-venant-kirchhoff for large deformation"
        ),
    ] = "linear",
    max_push: Annotated[
        float, typer.Option(help="depth up to which large deformation is built [m]")
    ] = 20e-3,
    pushed: Annotated[
        int,
        typer.Option(
            help="number of unseen sites at which large deformation is certified, about 15 s "
            "each; at two of them also with other effects, about 90 s each"
        ),
    ] = 12,
    certify: Annotated[int, typer.Option(help="number of unseen loads for the certificate")] = 200,
    contact_sites: Annotated[
        int,
        typer.Option(
            help="number of places, at least 3, at which contacts of spheres of 1.5 to 10 mm are "
            "resolved for the certificate, about 25 s each"
        ),
    ] = 0,
    seed: Annotated[
        int, typer.Option(min=0, help="random seed of the unseen loads and the contact sites")
    ] = 0,
    mesh_error: Annotated[
        bool,
        typer.Option(
            "--mesh-error", help="also measure the discretisation error of the mesh (slow)"
        ),
    ] = False,
    displayed: Annotated[
        int | None,
        typer.Option(
            help="approximate number of vertices of the displayed surface; default: 8000; 0: "
            "the mesh's own"
        ),
    ] = None,
    timings: Timings = None,
    overwrite: Overwrite = False,
) -> None:
    """Build the certified vademecum of an organ.

    Exit code 3: written, but not converged.
    """
    from avatar_core.fem.elasticity import Material
    from avatar_core.geometry.cut_surface import CutSurface
    from avatar_core.offline.large_deformation import LargeRule
    from avatar_core.offline.rule import BuildRule
    from avatar_core.offline.supports import SupportOption
    from avatar_core.pipeline import OrganOptions, build, notices_of
    from avatar_core.reduction.coordinates import Coordinate
    from avatar_core.vademecum.display import DISPLAYED
    from avatar_core.vademecum.storage import is_vademecum, load_vademecum, save_vademecum

    rule = BuildRule()
    rule = replace(rule, max_modes=modes or rule.max_modes, tolerance=tolerance or rule.tolerance)
    require(modes is None or modes >= 1, f"--modes is {modes}; ask for at least 1")
    require(
        tolerance is None or 0 < tolerance < 1,
        f"--tolerance is {tolerance}; it must lie between 0 and 1",
    )
    require(certify >= 1, f"--certify is {certify}; ask for at least 1 load")
    require(
        element in (None, "P1", "P2", "Taylor-Hood"),
        f"--element is {element}; choose P1, P2 or Taylor-Hood",
    )
    require(
        material in ("linear", "neo-hookean", "st-venant-kirchhoff"),
        f"--material is {material}; choose linear, neo-hookean or st-venant-kirchhoff",
    )
    if material == "linear":
        use = "for large deformation (--material neo-hookean)"
        refuse(ctx, ("max_push", "pushed"), use)
    refuse_for_phantom(ctx, surface)
    require(0 < max_push <= 0.05, f"--max-push is {max_push} m; choose up to 0.05 (20e-3: 20 mm)")
    require(pushed >= 0, f"--pushed is {pushed}; ask for 0 or more sites")
    inputs = (None if surface == "phantom" else surface, tumour, groups, resection)
    require_output(output, [".h5"], inputs, is_vademecum, overwrite)
    coordinates = tuple(Coordinate.parse(text) for text in coordinate or ())
    supports = tuple(SupportOption.parse(text) for text in support or ())
    require_timings(timings, inputs)
    clock = StageClock()
    clock.begin("surface")
    organ, lesion = _read_with_tumour(surface, unit, axes, label, tumour, tumour_label)
    options = OrganOptions(
        n_vertices=vertices,
        material=Material(young, poisson),
        coordinates=coordinates,
        supports=supports,
        resection=None if resection is None else CutSurface.read(resection),
        tumour=lesion,
        contrast=contrast,
        large=None if material == "linear" else material,  # type: ignore[arg-type]
        large_rule=LargeRule(max_push=max_push),
        n_pushed=pushed,
        element=element,  # type: ignore[arg-type]
        patch_radius=patch_radius,
        groups=groups,
        rule=rule,
        n_certified=certify,
        n_contact_sites=contact_sites,
        seed=seed,
        with_mesh_error=mesh_error,
        n_displayed=DISPLAYED if displayed is None else displayed,
    )
    notices = notices_of(organ, options)
    say_notices(notice for notice in notices if notice not in organ.notices)
    with stage_bar(build_stages(material != "linear", contact_sites)) as progress:
        report = clock.following(progress)
        built = build(organ, options, report)
    say_notices(built.provenance.notices[len(notices) :])
    clock.begin("save")
    save_vademecum(built, output)
    clock.begin("show")
    show_text(load_vademecum(output))
    show_timings(clock, timings)
    if not built.convergence.converged:
        best = built.convergence.rank_errors[-1]
        print(
            f"avatar: not converged: {best.rank} modes leave {best.mean:.1%} mean, "
            f"{best.worst:.1%} worst; the file is complete, and marked as not converged; "
            "raise --modes or "
            "--tolerance",
            file=sys.stderr,
        )
        raise typer.Exit(EXIT_NOT_CONVERGED)


def show(file: File, as_json: AsJson = False) -> None:
    """Show contents, errors and cost of a vademecum."""
    from avatar_core.vademecum.storage import load_vademecum

    v = load_vademecum(file)
    if not as_json:
        show_text(v)
        return
    curve = v.certificate.curve if v.certificate else None
    certificate = asdict(replace(v.certificate, curve=None)) if v.certificate else {}
    certificate |= {"bytes": v.nbytes}
    print(
        json.dumps(
            plain(
                {
                    **asdict(v.info()),
                    "element": v.element,
                    "contrast": v.contrast,
                    "supports": [
                        {
                            "name": one.name,
                            "stiffness": one.stiffness,
                            "area": supported_area(v, one),
                        }
                        for one in v.supports
                    ],
                    "resection": _resection_summary(v),
                    "coordinates": [
                        asdict(one) for one in (v.parametric.coordinates if v.parametric else ())
                    ],
                    "certificate": certificate,
                    "large": _large_summary(v),
                    "accuracy": curve.plain() if curve else None,
                    "provenance": asdict(v.provenance),
                    "rank_errors": [asdict(error) for error in v.convergence.rank_errors],
                }
            ),
            indent=2,
        )
    )


def _resection_summary(v: Vademecum) -> dict[str, Any] | None:
    """Return opening, volumes of both parts [m^3] and margins [m], for ``avatar show --json``."""
    from avatar_core.vademecum.resected import margins, part_volumes

    if v.resection is None:
        return None
    return {**asdict(v.resection), "volumes": part_volumes(v), "margins": margins(v)}


def _large_summary(v: Vademecum) -> dict[str, Any] | None:
    """Return the large deformation, for ``avatar show --json``."""
    if v.large is None:
        return None
    certificate = asdict(v.large.certificate) if v.large.certificate else None
    return {"material": v.large.material, "bytes": v.large.nbytes, "certificate": certificate}


def read_organ(
    surface: str, unit: str, axes: str | None, label: str | None, inside: Sequence[str] = ()
) -> SurfaceMesh:
    """Return a surface from a file, or the built-in liver; see ``read_surface``.

    Prints the notices of reading at once: they may explain a later refusal.
    """
    from avatar_core.geometry.phantom import phantom_liver
    from avatar_core.geometry.surface import read_surface

    if surface == "phantom":
        return phantom_liver()
    organ = read_surface(surface, unit, parsed_axes(axes), label, inside)
    say_notices(organ.notices)
    return organ


def _read_with_tumour(
    surface: str,
    unit: str,
    axes: str | None,
    label: str | None,
    tumour: Path | None,
    tumour_label: str | None,
) -> tuple[SurfaceMesh, SurfaceMesh | None]:
    """Return an organ, filled where its label leaves out the tumour, and the tumour if given.

    A tumour's label without a file is one of the organ's label map.
    """
    if tumour is None and tumour_label is None:
        return read_organ(surface, unit, axes, label), None
    if tumour is None:
        is_map = surface.lower().endswith(LABEL_MAPS)
        require(is_map, f"--tumour-label is for a label map, but {surface} is none; give --tumour")
        tumour = Path(surface)
    inside = (tumour_label,) if tumour_label and same_file(surface, tumour) else ()
    organ = read_organ(surface, unit, axes, label, inside)
    return organ, _read_tumour(tumour, unit, axes, tumour_label, organ)


def _read_tumour(
    file: Path, unit: str, axes: str | None, label: str | None, organ: SurfaceMesh
) -> SurfaceMesh:
    """Return a tumour in the given axes, those that its file states, or the organ's."""
    from avatar_core.geometry.surface_files import stated_axes
    from avatar_core.geometry.tumour import read_tumour

    if axes is not None:
        return read_tumour(file, unit, parsed_axes(axes), label)
    return read_tumour(file, unit, stated_axes(file) or organ.axes, label)


def parsed_axes(axes: str | None) -> Any:
    """Return a name of axes, 16 numbers as a 4x4 matrix, or None for those of the file."""
    if axes is None:
        return None
    numbers = axes.replace(",", " ").split()
    if len(numbers) != 16:
        return axes
    try:
        values = [float(number) for number in numbers]
    except ValueError as error:
        raise AvatarError(f"--axes holds no 4x4 matrix ({error}); give 16 numbers") from error
    return [values[4 * row : 4 * row + 4] for row in range(4)]


def require(condition: bool, message: str) -> None:
    """Raise AvatarError with the message unless the condition holds."""
    if not condition:
        raise AvatarError(message)


def say_notices(notices: Iterable[str]) -> None:
    """Print notices to standard error."""
    for notice in notices:
        print(f"notice: {notice}", file=sys.stderr)
