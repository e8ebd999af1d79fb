"""The ``avatar atlas`` command: create, add, show."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from avatar_core.cli.output import EXIT_STOPPED, require_output_folder
from avatar_core.cli.progress import item_bar
from avatar_core.cli.unused import refuse, refuse_for_phantom
from avatar_core.cli.vademecum import AsJson, Axes, Label, Unit, parsed_axes, say_notices
from avatar_core.errors import AvatarError
from avatar_core.geometry.surface_formats import LABEL_MAP_NAMES, MESH_NAMES, SUFFIXES

if TYPE_CHECKING:
    from avatar_core.atlas.growth import Growth, Source
    from avatar_core.atlas.model import Atlas


atlas = typer.Typer(
    help="Build and inspect atlases of known organs.",
    no_args_is_help=True,
    rich_markup_mode=None,  # markup would remove units like [m]
)

AtlasFolder = Annotated[Path, typer.Argument(metavar="ATLAS", help="folder of the atlas")]
Surfaces = Annotated[
    list[str],
    typer.Argument(
        metavar="SURFACE...",
        help=f"surface files ({MESH_NAMES}), label maps ({LABEL_MAP_NAMES}), folders of these, or "
        "'phantom', the built-in liver",
    ),
]
Jobs = Annotated[
    int | None, typer.Option(help="number of processes on this machine; default: one per CPU")
]
ShapesOnly = Annotated[
    bool,
    typer.Option("--shapes-only", help="compare shapes only: do not compute mechanical responses"),
]
Scheduler = Annotated[
    str | None,
    typer.Option(help="build on a Dask cluster instead: address of its scheduler, tcp://HOST:PORT"),
]


@atlas.command()
def create(
    ctx: typer.Context,
    folder: AtlasFolder,
    surfaces: Surfaces,
    unit: Unit = "mm",
    axes: Axes = None,
    label: Label = None,
    template_vertices: Annotated[
        int, typer.Option(help="approximate number of vertices of the template's mesh")
    ] = 2500,
    spacing: Annotated[
        float, typer.Option(help="spacing of the grid on which shapes are compared [m]")
    ] = 0.009,
    box: Annotated[
        tuple[float, float, float],
        typer.Option(help="size of the largest organ that fits, along x, y, z [m]"),
    ] = (0.33, 0.26, 0.26),
    shapes_only: ShapesOnly = False,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
) -> None:
    """Build an atlas from surfaces.

    Bad surfaces are skipped, with the reason. Each organ is written as soon as it is finished, and
    the same command goes on after an interruption. Exit code 1: no surface could be used, and
    nothing was written.
    """
    from avatar_core.atlas.growth import AtlasOptions, create_atlas

    require_output_folder(folder)
    sources = _sources(surfaces, unit, axes, label)
    _refuse_unused(ctx, sources)
    options = AtlasOptions(template_vertices, box, spacing)
    grow = partial(create_atlas, folder, sources, options)
    _report(folder, _grown(grow, len(sources), shapes_only, jobs, scheduler))


@atlas.command()
def add(
    ctx: typer.Context,
    folder: AtlasFolder,
    surfaces: Surfaces,
    unit: Unit = "mm",
    axes: Axes = None,
    label: Label = None,
    shapes_only: ShapesOnly = False,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
) -> None:
    """Add surfaces to an atlas.

    Existing members are neither computed nor written again. To remove an organ, delete its folder.
    Exit code 1: no surface could be used.
    """
    from avatar_core.atlas.growth import extend_atlas

    sources = _sources(surfaces, unit, axes, label)
    _refuse_unused(ctx, sources)
    grow = partial(extend_atlas, folder, sources)
    _report(folder, _grown(grow, len(sources), shapes_only, jobs, scheduler))


@atlas.command()
def show(folder: AtlasFolder, as_json: AsJson = False) -> None:
    """Show an atlas and its registrations."""
    from avatar_core.atlas.storage import load_atlas, n_bytes

    about = summary(load_atlas(folder), n_bytes(folder))
    if as_json:
        print(json.dumps(about, indent=2))
    else:
        _show_text(folder, about)


def summary(atlas: Atlas, nbytes: int) -> dict[str, Any]:
    """Return the data of ``avatar atlas show --json``; lengths in metres, volumes in m3."""
    copies = {one.name: one.of for one in atlas.duplicates}
    frame = atlas.frame
    return {
        "n_anatomies": len(atlas),
        "n_duplicates": len(copies),
        "bytes": nbytes,
        "template": {"name": frame.template.name, "n_vertices": len(frame.template.mesh.vertices)},
        "box": {
            "origin": list(frame.box.origin),
            "size": list(frame.box.upper - frame.box.origin),
            "spacing": frame.box.spacing,
            "shape": list(frame.box.shape),
            "n_points": frame.n_points,
        },
        "registration_tolerance": frame.rule.tolerance,
        "anatomies": [
            {
                "name": one.name,
                "source_sha256": one.origin.sha256,
                "unit": one.origin.unit,
                "axes": one.origin.axes,
                "n_vertices": one.origin.n_vertices,
                "volume": one.volume,
                "scale": one.alignment.scale,
                "angle_degrees": one.alignment.angle,
                "mean_distance": one.quality.mean_distance,
                "reverse_mean_distance": one.quality.reverse_mean_distance,
                "least_jacobian": one.quality.least_jacobian,
                "converged": one.converged,
                "duplicate_of": copies.get(one.name),
                "response_rank": one.response.rank if one.response else None,
                "notices": list(one.origin.notices),
            }
            for one in atlas.anatomies
        ],
    }


def _show_text(folder: Path, about: dict[str, Any]) -> None:
    box = about["box"]
    print(
        f"{folder.name}: {about['n_anatomies']} anatomies ({about['n_duplicates']} duplicates), "
        f"{about['bytes'] / 1e6:.1f} MB"
    )
    print(f"  template {about['template']['name']}, {about['template']['n_vertices']} vertices")
    print(
        f"  grid {' x '.join(map(str, box['shape']))} points, {box['spacing'] * 1e3:g} mm apart, "
        f"{' x '.join(f'{side * 1e3:.0f}' for side in box['size'])} mm"
    )
    print(f"  {'name':24s} {'ml':>6s} {'scale':>6s} {'turn':>6s} {'off by':>8s}  response")
    for one in about["anatomies"]:
        marks = [] if one["converged"] else ["registration not converged"]
        marks += [f"duplicate of {one['duplicate_of']}"] if one["duplicate_of"] else []
        rank = one["response_rank"]
        print(
            f"  {one['name']:24s} {one['volume'] * 1e6:6.0f} {one['scale']:6.3f} "
            f"{one['angle_degrees']:4.0f}\N{DEGREE SIGN} {one['mean_distance'] * 1e3:7.2f}mm  "
            f"{'-' if rank is None else f'{rank} modes':8s}  {', '.join(marks)}".rstrip()
        )


def _grown(
    grow: Callable[..., Growth],
    n_sources: int,
    shapes_only: bool,
    jobs: int | None,
    scheduler: str | None,
) -> Growth:
    """Return the atlas after its growth; after Ctrl-C, print how to go on."""
    from avatar_core.atlas.response import ResponseSolver
    from avatar_core.atlas.workers import Workers

    response = None if shapes_only else ResponseSolver()
    try:
        with item_bar(n_sources) as progress:
            workers = Workers(jobs, scheduler)
            return grow(workers=workers, solve_response=response, progress=progress)
    except KeyboardInterrupt:
        print("avatar: run the same command again to resume", file=sys.stderr)
        raise typer.Exit(EXIT_STOPPED) from None


def _report(folder: Path, growth: Growth) -> None:
    """Print added and skipped surfaces; raise AvatarError if no surface could be used."""
    for one in growth.skipped:
        print(f"skipped: {one.name}: {one.reason.removeprefix(f'{one.name}: ')}", file=sys.stderr)
    say_notices(growth.notices)
    n_sources = len(growth.added) + len(growth.known) + len(growth.skipped)
    if len(growth.skipped) == n_sources:
        raise AvatarError(f"none of {n_sources} surface(s) can be used; nothing was written")
    known = f", {len(growth.known)} there before" if growth.known else ""
    print(
        f"{folder}: {len(growth.added)} of {n_sources} added{known}, {len(growth.skipped)} "
        f"skipped; {len(growth.atlas)} anatomies"
    )


def _sources(
    surfaces: Sequence[str], unit: str, axes: str | None, label: str | None
) -> list[Source]:
    """Return the named surfaces, and those of a folder in the order of their names."""
    from avatar_core.atlas.growth import SurfaceFile
    from avatar_core.geometry.label_files import is_label_map
    from avatar_core.geometry.phantom import phantom_liver
    from avatar_core.geometry.surface import METRES, axes_matrix

    parsed = parsed_axes(axes)
    if parsed is not None:
        axes_matrix(parsed)  # an error in the options, not in each file
    if unit not in METRES:
        raise AvatarError(f"--unit is '{unit}'; use one of {', '.join(METRES)}")
    frozen = parsed if parsed is None or isinstance(parsed, str) else tuple(map(tuple, parsed))
    sources: list[Source] = []
    for name in surfaces:
        if name == "phantom":
            sources.append(phantom_liver())
        else:
            sources += [
                SurfaceFile(path, unit, frozen, label if is_label_map(path) else None)
                for path in _files(Path(name))
            ]
    return sources


def _refuse_unused(ctx: typer.Context, sources: Sequence[Source]) -> None:
    """Refuse options of files, or of label maps, if there is none among the sources."""
    from avatar_core.atlas.growth import SurfaceFile
    from avatar_core.geometry.label_files import is_label_map

    files = [one.path for one in sources if isinstance(one, SurfaceFile)]
    if not files:
        refuse_for_phantom(ctx, "phantom")
    if not any(map(is_label_map, files)):
        refuse(ctx, ("label",), "for label maps, and none of these files is one")


def _files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    found = sorted(one for one in path.iterdir() if one.name.lower().endswith(SUFFIXES))
    if not found:
        raise AvatarError(f"no surface in {path}; it should hold files of {', '.join(SUFFIXES)}")
    return found
