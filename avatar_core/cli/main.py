"""The ``avatar`` command."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from avatar_core.cli.atlas import atlas
from avatar_core.cli.bench import bench, require_ros, require_seconds, run_cell
from avatar_core.cli.calibrate import calibrate
from avatar_core.cli.cell import Host, Port, cell, require_ui, run_page
from avatar_core.cli.export import export
from avatar_core.cli.output import EXIT_STOPPED, require_output
from avatar_core.cli.patient import patient
from avatar_core.cli.progress import build_stages, stage_bar
from avatar_core.cli.register import register
from avatar_core.cli.replay import replay
from avatar_core.cli.scene import scene
from avatar_core.cli.study import study
from avatar_core.cli.uncertainty import uncertainty
from avatar_core.cli.unused import refuse
from avatar_core.cli.vademecum import Vertices, show, show_text, vademecum
from avatar_core.errors import AvatarError

if TYPE_CHECKING:
    from avatar_core.vademecum.model import Vademecum

app = typer.Typer(
    help="Computational patient avatars: compute the mechanical response of an organ once, and "
    "evaluate it at 1 kHz.",
    no_args_is_help=True,
    rich_markup_mode=None,  # markup would remove units like [m]
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(bench, name="bench")
app.add_typer(atlas, name="atlas")
app.add_typer(scene, name="scene")
app.command()(vademecum)
app.command()(show)
app.command()(export)
app.command()(patient)
app.command()(register)
app.command()(replay)
app.command()(uncertainty)
app.command()(calibrate)
app.command()(study)
app.command()(cell)


def main() -> int:
    """Run the command; errors of the input become one line and exit code 1."""
    try:
        code = app(standalone_mode=False)
    except AvatarError as error:
        print(f"avatar: {error}", file=sys.stderr)
        return 1
    except Exception as error:
        return _usage(error)
    if code == EXIT_STOPPED:
        print("avatar: stopped; nothing was left half written", file=sys.stderr)
    return code if isinstance(code, int) else 0


def _usage(error: Exception) -> int:
    """Show a usage error of the command line; any other error is a bug and is raised."""
    show = getattr(error, "show", None)
    if show is None:
        raise error
    show()
    return int(getattr(error, "exit_code", 2))


@app.command()
def demo(
    ctx: typer.Context,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="file of the picture (.png, .pdf, .svg)")
    ] = Path("avatar_demo.png"),
    cell: Annotated[
        bool,
        typer.Option(
            "--cell", help="also run the ROS 2 nodes with a scripted tool; print rate and latency"
        ),
    ] = False,
    seconds: Annotated[float, typer.Option(help="duration of each run of --cell [s]")] = 10.0,
    vertices: Vertices = 1200,
    ui: Annotated[
        bool,
        typer.Option("--ui", help="serve the planning page in the browser instead of a picture"),
    ] = False,
    host: Host = "127.0.0.1",
    port: Port = 8080,
) -> None:
    """Build, press and draw the built-in liver.

    The picture has its response first, within a minute. A first run then compiles the step, and the
    picture shows the force on a tool beside resolved contact. Only --cell and --ui need ROS 2.
    """
    import tempfile

    from avatar_core.cli.picture import palpation_picture, response_picture
    from avatar_core.geometry.phantom import phantom_liver
    from avatar_core.pipeline import OrganOptions, build
    from avatar_core.vademecum.storage import load_vademecum, save_vademecum

    if ui:
        refuse(ctx, ("output", "cell", "seconds"), "not for --ui, which serves the page instead")
    else:
        refuse(ctx, ("host", "port"), "for the planning page (--ui)")
    if not cell:
        refuse(ctx, ("seconds",), "for --cell")
    require_seconds(seconds)
    if cell or ui:
        require_ros()
    if ui:
        require_ui()
    else:
        require_output(output, [".png", ".pdf", ".svg"], [])
    print("1. building the vademecum of the built-in liver", flush=True)
    surface = phantom_liver()

    def draw(response: Vademecum) -> None:
        if not ui:
            response_picture(response, output)
            print(f"   {output} shows its response; certifying it", flush=True)

    with stage_bar(build_stages()) as progress:
        built = build(surface, OrganOptions(n_vertices=vertices), progress, draw)
    with tempfile.TemporaryDirectory(prefix="avatar_demo_") as folder:
        file = Path(folder) / "phantom.h5"
        save_vademecum(built, file)
        v = load_vademecum(file)
        show_text(v)
        if ui:
            print("2. running the cell; open the address of its page below (Ctrl-C ends both)")
            run_page(file, host, port)
            return
        print("2. pressing a sphere into it", flush=True)
        with stage_bar() as progress:
            palpation_picture(
                v, surface, output, lambda done: progress("contacts", done, float("nan"))
            )
        print(f"   {output} shows the force beside resolved contact")
        if cell:
            print(f"3. running loader, contact and tool as ROS 2 processes, {seconds:g} s each run")
            run_cell(file, seconds)


if __name__ == "__main__":
    raise SystemExit(main())
