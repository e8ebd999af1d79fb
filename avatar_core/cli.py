"""The ``avatar`` command."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import typer

from avatar_core.cli_atlas import atlas
from avatar_core.errors import AvatarError

if TYPE_CHECKING:
    from avatar_core.bench import StepRow
    from avatar_core.surface import SurfaceMesh
    from avatar_core.vademecum import Vademecum

EXIT_NOT_CONVERGED = 3
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

Surface = Annotated[
    str,
    typer.Argument(
        help="OBJ, STL, PLY, VTK, OFF or label map (.nii, .nii.gz); 'phantom' is the built-in liver"
    ),
]
Unit = Annotated[str, typer.Option(help="unit of the file: mm, cm or m")]
Axes = Annotated[
    str, typer.Option(help="axes of the file: RAS, LPS, or 16 numbers of a 4x4 matrix to RAS")
]
Label = Annotated[int | None, typer.Option(help="label of the organ in a label map")]
Vertices = Annotated[int, typer.Option(help="number of mesh vertices, about")]
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
def vademecum(
    surface: Surface,
    output: Annotated[Path, typer.Option("-o", "--output", help="vademecum to write (.h5)")],
    unit: Unit = "mm",
    axes: Axes = "RAS",
    label: Label = None,
    vertices: Vertices = 2850,
    young: Annotated[float, typer.Option(help="Young's modulus [Pa]")] = 0.17e6,
    poisson: Annotated[float, typer.Option(help="Poisson's ratio, 0 to below 0.5 [-]")] = 0.48,
    patch_radius: Annotated[
        float | None,
        typer.Option(help="radius of a tool's load patch [m]; default max(12 mm, 1.2 edges)"),
    ] = None,
    modes: Annotated[int, typer.Option(help="far-field modes at most")] = 100,
    tolerance: Annotated[
        float, typer.Option(help="mean relative displacement error over the build's loads [-]")
    ] = 0.045,
    groups: Annotated[
        Path | None,
        typer.Option(help=".npz with points 'clamped' and 'accessible' [m], instead of the rule"),
    ] = None,
    element: Annotated[
        str | None, typer.Option(help="P1, P2 or Taylor-Hood; default by Poisson's ratio")
    ] = None,
    certify: Annotated[int, typer.Option(help="unseen loads of the certificate")] = 200,
    seed: Annotated[int, typer.Option(help="of the unseen loads")] = 0,
    mesh_error: Annotated[
        bool, typer.Option("--mesh-error", help="also measure the mesh's own error (slow)")
    ] = False,
) -> None:
    """Build the certified vademecum of an organ. Exit code 3: complete, but not converged."""
    from avatar_core.build import BuildRule
    from avatar_core.elasticity import Material
    from avatar_core.organ import OrganOptions, orientation_warning, vademecum_of
    from avatar_core.storage import load_vademecum, save_vademecum

    _require(modes >= 1, f"--modes is {modes}; ask for at least 1")
    _require(0 < tolerance < 1, f"--tolerance is {tolerance}; it must lie between 0 and 1")
    _require(certify >= 1, f"--certify is {certify}; ask for at least 1 load")
    _require(
        element in (None, "P1", "P2", "Taylor-Hood"),
        f"--element is {element}; choose P1, P2 or Taylor-Hood",
    )
    _require(output.parent.is_dir(), f"folder {output.parent} does not exist; create it first")
    options = OrganOptions(
        n_vertices=vertices,
        material=Material(young, poisson),
        element=element,  # type: ignore[arg-type]
        patch_radius=patch_radius,
        groups=groups,
        rule=BuildRule(tolerance=tolerance, max_modes=modes),
        n_certified=certify,
        seed=seed,
        with_mesh_error=mesh_error,
    )
    organ = _read(surface, unit, axes, label)
    for notice in organ.notices:
        print(f"notice: {notice}", file=sys.stderr)
    warning = orientation_warning(organ)
    if warning:
        print(f"warning: {warning}", file=sys.stderr)
    with _Bar() as progress:
        built = vademecum_of(organ, options, progress)
    save_vademecum(built, output)
    _show_text(load_vademecum(output))
    if not built.convergence.converged:
        best = built.convergence.rank_errors[-1]
        print(
            f"avatar: not converged: {best.rank} modes leave {best.mean:.1%} mean, "
            f"{best.worst:.1%} worst; the file is complete and marked; raise --modes or "
            "--tolerance",
            file=sys.stderr,
        )
        raise typer.Exit(EXIT_NOT_CONVERGED)


@app.command()
def show(
    file: Annotated[Path, typer.Argument(help="a vademecum (.h5)")],
    as_json: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
) -> None:
    """Say what a vademecum is, how wrong it may be, and what it cost."""
    from avatar_core.storage import load_vademecum

    v = load_vademecum(file)
    if not as_json:
        _show_text(v)
        return
    certificate = {**(asdict(v.certificate) if v.certificate else {}), "bytes": v.nbytes}
    print(
        json.dumps(
            _finite(
                {
                    **asdict(v.info()),
                    "element": v.element,
                    "certificate": certificate,
                    "provenance": asdict(v.provenance),
                    "rank_errors": [asdict(error) for error in v.convergence.rank_errors],
                }
            ),
            indent=2,
        )
    )


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
    with _Bar() as progress:
        built = vademecum_of(phantom_liver(), OrganOptions(n_vertices=vertices), progress)
    with tempfile.TemporaryDirectory(prefix="avatar_demo_") as folder:
        file = Path(folder) / "phantom.h5"
        save_vademecum(built, file)
        v = load_vademecum(file)
        _show_text(v)
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

    organ = _read(surface, unit, axes, label)
    with _Bar() as progress:
        rows, summary = run_step_bench(organ, small, large, progress)
    print(
        f"load average {load_average():.2f}; 10 mm spheres sliding 5 mm deep, field at all vertices"
    )
    print(_step_table(rows))
    for key, value in summary.items():
        print(f"{key:22s} {value:10.1f}")
    if output is not None:
        document = {"name": "step", "summary": summary, "rows": [asdict(row) for row in rows]}
        output.write_text(json.dumps(_finite(document), indent=2))


@bench.command("cell")
def bench_cell(
    surface: Surface = "phantom",
    seconds: Annotated[float, typer.Option(help="of each run [s]")] = 60.0,
    vertices: Vertices = 2850,
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
            with _Bar() as progress:
                built = vademecum_of(
                    _read(surface, "mm", "RAS", None), OrganOptions(n_vertices=vertices), progress
                )
            file = Path(folder) / "bench.h5"
            save_vademecum(built, file)
        report = run_cell(file, seconds, output)
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


def _read(surface: str, unit: str, axes: str, label: int | None) -> SurfaceMesh:
    from avatar_core.phantom import phantom_liver
    from avatar_core.surface import read_surface

    if surface == "phantom":
        return phantom_liver()
    return read_surface(surface, unit, _parsed_axes(axes), label)


def _parsed_axes(axes: str) -> Any:
    numbers = axes.replace(",", " ").split()
    if len(numbers) != 16:
        return axes
    try:
        values = [float(number) for number in numbers]
    except ValueError as error:
        raise AvatarError(f"--axes holds no 4x4 matrix ({error}); give 16 numbers") from error
    return [values[4 * row : 4 * row + 4] for row in range(4)]


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise AvatarError(message)


def _show_text(v: Vademecum) -> None:
    info, c = v.info(), v.certificate
    print(f"{info.name}  (from {info.source}, {v.provenance.unit}, axes {info.axes})")
    print(
        f"  {info.n_vertices} vertices ({info.n_surface_vertices} on the surface), "
        f"{info.volume * 1e6:.0f} ml, {v.element}, E {info.young_modulus:g} Pa, "
        f"nu {info.poisson_ratio:g}"
    )
    print(
        f"  {info.n_load_positions} load positions, patch radius {info.patch_radius * 1e3:.1f} mm, "
        f"{info.n_modes} modes, {info.bytes / 1e6:.1f} MB"
    )
    if c is None:
        print("  no certificate")
        return
    print(f"  errors on {c.n_loads} unseen loads x 3 directions    mean     worst")
    for name, mean, worst in (
        ("displacement, L2", c.l2_mean, c.l2_worst),
        ("contact compliance", c.contact_mean, c.contact_worst),
        ("force of an indentation", c.force_mean, c.force_worst),
        ("the same, felt by a sliding tip", c.felt_mean, c.felt_worst),
    ):
        print(f"    {name:38s} {mean:8.2%}  {worst:8.2%}")
    print(f"  built in {c.build_cpu_seconds:.0f} s of CPU time", end="")
    state = "converged" if info.converged else "NOT CONVERGED"
    print(f", {state} (tolerance {v.convergence.tolerance:.1%})")
    if not math.isnan(c.mesh_l2):
        print(f"  mesh refined once: displacement {c.mesh_l2:.1%}, contact {c.mesh_contact:.1%}")


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


def _finite(value: Any) -> Any:
    """JSON has no NaN: null instead."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


class _Bar:
    """One progress bar over the stages of a build."""

    _SHARE: ClassVar = {"mesh": 0.1, "solve": 0.4, "modes": 0.35, "certify": 0.15}

    def __enter__(self) -> _Bar:
        from tqdm import tqdm

        self._bar = tqdm(
            total=1.0,
            bar_format="{desc:12s} {percentage:3.0f}% |{bar}| {elapsed}",
            file=sys.stderr,
            disable=None,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def __call__(self, stage: str, fraction: float) -> None:
        """Stage ``stage`` is done to ``fraction``."""
        before = 0.0
        for name, share in self._SHARE.items():
            if name == stage:
                break
            before += share
        share = self._SHARE.get(stage, 0.0)
        self._bar.set_description_str(stage, refresh=False)
        self._bar.n = min(1.0, before + share * min(fraction, 1.0))
        self._bar.refresh()


if __name__ == "__main__":
    raise SystemExit(main())
