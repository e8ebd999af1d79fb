"""``avatar bench step | effects | cell | start | idle``: check whether this machine holds 1 kHz."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from avatar_core.cli.output import require_output
from avatar_core.cli.progress import build_stages, stage_bar, waiting
from avatar_core.cli.unused import refuse_for_built, refuse_for_phantom
from avatar_core.cli.vademecum import Axes, Label, Unit, Vertices, read_organ, require
from avatar_core.common.dataclass_json import plain
from avatar_core.errors import AvatarError

if TYPE_CHECKING:
    from avatar_core.studies.bench.effects import EffectRow
    from avatar_core.studies.bench.methods import StepRow

bench = typer.Typer(
    help="Measure whether this machine holds 1 kHz.",
    no_args_is_help=True,
    rich_markup_mode=None,  # markup would remove units like [m]
)

SurfaceOrVademecum = Annotated[
    str,
    typer.Argument(
        help="surface file or label map, or a vademecum (.h5); 'phantom': the built-in liver"
    ),
]
Json = Annotated[
    Path | None, typer.Option("-o", "--output", help="also write the table to this file, as JSON")
]


@bench.command("step")
def bench_step(
    ctx: typer.Context,
    surface: SurfaceOrVademecum = "phantom",
    unit: Unit = "mm",
    axes: Axes = None,
    label: Label = None,
    vertices: Vertices = 2850,
    displayed: Annotated[
        list[int] | None,
        typer.Option(
            help="approximate number of vertices of a displayed surface; 0: none; may be "
            "repeated; default: 20000 and 100000"
        ),
    ] = None,
    output: Json = None,
) -> None:
    """Time the contact step and its rivals.

    The rivals are a dense table and a direct solve; building takes a minute. For a vademecum (.h5):
    the step with its own displayed surface, and a dense table.
    """
    from avatar_core.geometry.resampling import require_displayable
    from avatar_core.studies.bench.methods import load_average
    from avatar_core.studies.bench.step import run_step_bench, time_organ
    from avatar_core.vademecum.storage import load_vademecum

    _require_json(output, surface)
    is_built = Path(surface).suffix == ".h5"
    if is_built:
        refuse_for_built(ctx, surface, "unit", "axes", "label", "vertices", "displayed")
    refuse_for_phantom(ctx, surface)
    shown = [n for n in displayed or (20_000, 100_000) if n != 0]
    for n in shown:
        require_displayable(n)
    if is_built:
        vademecum = load_vademecum(surface)
        _compile()
        rows, summary = time_organ(vademecum)
    else:
        organ = read_organ(surface, unit, axes, label)
        with stage_bar(build_stages()) as progress:
            rows, summary = run_step_bench(organ, vertices, shown, progress)
    print(
        f"load average {load_average():.2f}; 10 mm spheres sliding 5 mm deep, field at all shown "
        "vertices"
    )
    print(_step_table(rows))
    for key, value in summary.items():
        print(f"{key:22s} {value:10.4g}")
    _write(output, "step", summary, rows)


@bench.command("effects")
def bench_effects(
    ctx: typer.Context,
    surface: SurfaceOrVademecum = "phantom",
    unit: Unit = "mm",
    axes: Axes = None,
    label: Label = None,
    vertices: Vertices = 2850,
    modes: Annotated[int, typer.Option(help="largest number of modes at a place")] = 100,
    output: Json = None,
) -> None:
    """Time the step with each effect.

    The step is timed without effects, with each one, and with all; building takes minutes. For a
    vademecum (.h5): with the effects that it supports.
    """
    from avatar_core.studies.bench.effects import build_for_effects, run_effects_bench
    from avatar_core.studies.bench.methods import load_average
    from avatar_core.vademecum.storage import load_vademecum

    require(modes >= 36, f"--modes is {modes}; inertia and self_weight need at least 36")
    _require_json(output, surface)
    is_built = Path(surface).suffix == ".h5"
    if is_built:
        refuse_for_built(ctx, surface, "unit", "axes", "label", "vertices", "modes")
    refuse_for_phantom(ctx, surface)
    if is_built:
        vademecum = load_vademecum(surface)
    else:
        organ = read_organ(surface, unit, axes, label)
        with stage_bar(build_stages(large=True)) as progress:
            vademecum = build_for_effects(organ, vertices, modes, progress)
    _compile()

    def announce(scene: str) -> None:
        print(f"timing: {scene}", file=sys.stderr, flush=True)

    rows, summary = run_effects_bench(vademecum, announce)
    print(
        f"load average {load_average():.2f}; {len(vademecum.mesh.vertices)} vertices; 10 mm "
        "spheres sliding 5 mm deep, field at all vertices at every step"
    )
    print(_effects_table(rows))
    for key, value in summary.items():
        print(f"{key:22s} {value:10.3f}")
    _write(output, "effects", summary, rows)


def _compile() -> None:
    """Compile the step, with a message if it takes long."""
    from avatar_core.contact.model import compiled_step

    with waiting("compiling the step, once on this machine"):
        compiled_step()


def _effects_table(rows: list[EffectRow]) -> str:
    lines = [f"{'scene':20s}{'tools':>6s}{'p50 us':>9s}{'p99 us':>9s}{'x bare':>8s}{'MB':>8s}"]
    lines += [
        f"{r.scene:20s}{r.tools:6d}{r.p50_us:9.1f}{r.p99_us:9.1f}{r.ratio:8.2f}{r.bytes / 1e6:8.1f}"
        for r in rows
    ]
    return "\n".join(lines)


@bench.command("cell")
def bench_cell(
    ctx: typer.Context,
    surface: SurfaceOrVademecum = "phantom",
    seconds: Annotated[float, typer.Option(help="duration of each run [s]")] = 60.0,
    vertices: Vertices = 2850,
    changes: Annotated[
        float, typer.Option(help="rate of material changes during the run [Hz]")
    ] = 0.0,
    output: Json = None,
) -> None:
    """Time the whole ROS 2 cell.

    Tool, contact and cloud subscriber are separate processes. Also reports whether memory, open
    files or threads of a process keep growing. Run it with --seconds 600 for a soak test.
    """
    import tempfile

    from avatar_core.pipeline import OrganOptions, build
    from avatar_core.vademecum.storage import save_vademecum

    require_seconds(seconds)
    require(0.0 <= changes <= 1e3, f"--changes is {changes:g} Hz; give 0 to 1000")
    file = Path(surface)
    if file.suffix == ".h5":
        refuse_for_built(ctx, surface, "vertices")
    require_ros()
    _require_json(output, surface)
    with tempfile.TemporaryDirectory(prefix="avatar_bench_") as folder:
        if file.suffix != ".h5":
            with stage_bar(build_stages()) as progress:
                built = build(
                    read_organ(surface, "mm", None, None),
                    OrganOptions(n_vertices=vertices),
                    progress,
                )
            file = Path(folder) / "bench.h5"
            save_vademecum(built, file)
        run_cell(file, seconds, output, changes)


@bench.command("start")
def bench_start(
    vademecum: Annotated[
        Path, typer.Argument(exists=True, dir_okay=False, help="vademecum to load (.h5)")
    ],
    output: Json = None,
) -> None:
    """Time a cell's start, stage by stage.

    Stages run from `avatar cell` to the first force.
    """
    require_ros()
    _require_json(output, vademecum)
    _run_module("start", [str(vademecum.resolve())], output)


@bench.command("idle")
def bench_idle(
    seconds: Annotated[float, typer.Option(help="duration of the measurement [s]")] = 20.0,
    atlas: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="atlas for the service that builds patients; without one the service "
            "starts, but is not configured",
        ),
    ] = None,
    output: Json = None,
) -> None:
    """Print the processor use of idle nodes.

    Each thread of the nodes is measured while there is nothing to do.
    """
    require_seconds(seconds)
    require_ros()
    _require_json(output, atlas)
    options = ["--atlas", str(atlas.resolve())] if atlas is not None else []
    _run_module("idle", [f"{seconds:g}", *options], output)


def _write(
    output: Path | None, name: str, summary: dict[str, float], rows: Sequence[StepRow | EffectRow]
) -> None:
    if output is not None:
        document = {"name": name, "summary": summary, "rows": [asdict(row) for row in rows]}
        output.write_text(json.dumps(plain(document), indent=2))


def _require_json(output: Path | None, *inputs: str | Path | None) -> None:
    """Raise StorageError, before minutes of work, if the table cannot be written."""
    if output is not None:
        require_output(output, [".json"], inputs, overwrite=True)


def require_seconds(seconds: float) -> None:
    """Raise AvatarError unless a measurement can take as long."""
    require(1.0 <= seconds <= 1e6, f"--seconds is {seconds:g}; give at least 1")


def require_ros() -> None:
    """Raise AvatarError, before anything is built, if ROS 2 is not installed."""
    missing = [name for name in ("avatar_ros", "rclpy") if find_spec(name) is None]
    if missing:
        raise AvatarError(
            f"ROS 2 is not installed here (no {missing[0]}); install avatar without AVATAR_NO_ROS "
            "on Linux x86_64: pip install ."
        )


def run_cell(
    vademecum: Path, seconds: float, output: Path | None = None, changes: float = 0.0
) -> None:
    """Measure the cell in a separate process, which prints the table or a one-line error."""
    arguments = [str(vademecum), f"{seconds:g}", "--changes", f"{changes:g}"]
    _run_module("cell", arguments, output)


def _run_module(name: str, arguments: list[str], output: Path | None) -> None:
    """Run a benchmark of avatar_ros; pass on its exit code if it fails."""
    command = [sys.executable, "-m", f"avatar_ros.bench.{name}", *arguments]
    command += ["--output", str(output)] if output is not None else []
    sys.stdout.flush()  # keeps the order of output in a file
    code = subprocess.run(command, check=False).returncode
    if code != 0:
        raise typer.Exit(code)


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
