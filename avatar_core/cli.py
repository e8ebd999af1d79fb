"""The ``avatar`` command."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from avatar_core.cli_atlas import atlas
from avatar_core.cli_patient import patient
from avatar_core.cli_study import study
from avatar_core.cli_vademecum import (
    Axes,
    BuildBar,
    Label,
    Surface,
    Unit,
    Vertices,
    finite,
    read_organ,
    show,
    show_text,
    vademecum,
)
from avatar_core.errors import AvatarError

if TYPE_CHECKING:
    from avatar_core.bench import StepRow

EXIT_STOPPED = 130  # by Ctrl-C, as shells count it

app = typer.Typer(
    help="Computational patient avatars: an organ's mechanical response, computed once, "
    "answered at 1 kHz.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
bench = typer.Typer(help="Does this machine hold 1 kHz?", no_args_is_help=True)
app.add_typer(bench, name="bench")
app.add_typer(atlas, name="atlas")
app.command()(vademecum)
app.command()(show)
app.command()(patient)
app.command()(study)

Json = Annotated[Path | None, typer.Option("-o", "--output", help="write the table as JSON")]


def main() -> int:
    """Entry point: errors of the user become one line and exit code 1."""
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
    """Show a usage error of the command line; anything else is a bug and is raised."""
    show = getattr(error, "show", None)
    if show is None:
        raise error
    show()
    return int(getattr(error, "exit_code", 2))


@app.command()
def demo(
    output: Annotated[Path, typer.Option("-o", "--output", help="picture to draw")] = Path(
        "avatar_demo.png"
    ),
    seconds: Annotated[float, typer.Option(help="of palpation over ROS 2 [s]")] = 10.0,
    vertices: Vertices = 1200,
) -> None:
    """Phantom -> vademecum -> ROS 2 nodes at 1 kHz under a scripted tool -> table, picture."""
    import tempfile

    from avatar_core.organ import OrganOptions, vademecum_of
    from avatar_core.phantom import phantom_liver
    from avatar_core.picture import palpation_picture
    from avatar_core.storage import load_vademecum, save_vademecum

    run_cell = _ros_cell()
    print("1. a liver that the code generates becomes a vademecum")
    with BuildBar() as progress:
        built = vademecum_of(phantom_liver(), OrganOptions(n_vertices=vertices), progress)
    with tempfile.TemporaryDirectory(prefix="avatar_demo_") as folder:
        file = Path(folder) / "phantom.h5"
        save_vademecum(built, file)
        v = load_vademecum(file)
        show_text(v)
        print(f"2. loader, contact and tool as real ROS 2 processes for {seconds:g} s")
        report = run_cell(file, seconds)
    print(report.table())
    print("3. the picture")
    palpation_picture(v, output)
    print(f"   {output}")


@bench.command("step")
def bench_step(
    surface: Surface = "phantom",
    unit: Unit = "mm",
    axes: Axes = "RAS",
    label: Label = None,
    small: Annotated[int, typer.Option(help="vertices of the small mesh, about")] = 2850,
    large: Annotated[int, typer.Option(help="vertices of the large mesh (P1); 0: none")] = 20000,
    output: Json = None,
) -> None:
    """Time the contact step beside a dense table and a direct solve (minutes to build)."""
    from avatar_core.bench import load_average
    from avatar_core.bench_step import run_step_bench

    organ = read_organ(surface, unit, axes, label)
    with BuildBar() as progress:
        rows, summary = run_step_bench(organ, small, large, progress)
    print(
        f"load average {load_average():.2f}; 10 mm spheres sliding 5 mm deep, field at all vertices"
    )
    print(_step_table(rows))
    for key, value in summary.items():
        print(f"{key:22s} {value:10.1f}")
    if output is not None:
        document = {"name": "step", "summary": summary, "rows": [asdict(row) for row in rows]}
        output.write_text(json.dumps(finite(document), indent=2))


@bench.command("cell")
def bench_cell(
    surface: Surface = "phantom",
    seconds: Annotated[float, typer.Option(help="of each run [s]")] = 60.0,
    vertices: Vertices = 2850,
    changes: Annotated[
        float, typer.Option(help="times a second that the material is changed meanwhile [Hz]")
    ] = 0.0,
    output: Json = None,
) -> None:
    """Time the whole ROS 2 cell: tool, contact and cloud subscriber as separate processes."""
    import tempfile

    from avatar_core.organ import OrganOptions, vademecum_of
    from avatar_core.storage import save_vademecum

    run_cell = _ros_cell()
    with tempfile.TemporaryDirectory(prefix="avatar_bench_") as folder:
        file = Path(surface)
        if file.suffix != ".h5":
            with BuildBar() as progress:
                built = vademecum_of(
                    read_organ(surface, "mm", "RAS", None),
                    OrganOptions(n_vertices=vertices),
                    progress,
                )
            file = Path(folder) / "bench.h5"
            save_vademecum(built, file)
        report = run_cell(file, seconds, output, changes=changes)
    print(report.table())


def _ros_cell() -> Any:
    try:
        from avatar_ros.bench_cell import run_cell
    except ImportError as error:
        raise AvatarError(
            f"ROS 2 is not installed here ({error}); install avatar without AVATAR_NO_ROS on "
            "Linux x86_64: pip install ."
        ) from error
    return run_cell


def _step_table(rows: list[StepRow]) -> str:
    lines = [
        f"{'method':22s} {'vertices':>8s} {'modes':>5s} {'tools':>5s} {'contacts':>8s} "
        f"{'p50 us':>8s} {'p99 us':>8s} {'MB':>8s}"
    ]
    lines += [
        f"{r.method:22s} {r.vertices:8d} {r.modes or '-':>5} {r.tools:5d} "
        f"{r.contacts_mean:8.1f} {r.p50_us:8.1f} {r.p99_us:8.1f} {r.bytes / 1e6:8.1f}"
        for r in rows
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
