"""``avatar patient``: a new patient's vademecum from an atlas."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from avatar_core.cli.output import Overwrite, require_output
from avatar_core.cli.progress import stage_bar
from avatar_core.cli.timings import StageClock, Timings, require_timings, show_timings
from avatar_core.cli.unused import refuse_for_phantom
from avatar_core.cli.vademecum import (
    EXIT_NOT_CONVERGED,
    Axes,
    Groups,
    Label,
    Output,
    Supports,
    Surface,
    Unit,
    Vertices,
    read_organ,
    require,
    say_notices,
    show_text,
)

if TYPE_CHECKING:
    from avatar_core.atlas.patient import Patient

WEIGHTINGS = ("kriging", "lle-template", "lle-grid", "lle-paper")


def patient(
    ctx: typer.Context,
    surface: Surface,
    atlas: Annotated[Path, typer.Option(help="folder made by 'avatar atlas create'")],
    output: Output,
    fidelity: Annotated[
        str,
        typer.Option(
            help="interpolated: from the responses of known organs, in seconds; reduced: "
            "solved on the patient's own mesh, in a space spanned by these responses; "
            "solved: full finite elements"
        ),
    ] = "reduced",
    tolerance: Annotated[
        float,
        typer.Option(help="target of 'reduced' for the mean relative error of displacement [-]"),
    ] = 0.02,
    weighting: Annotated[
        str,
        typer.Option(
            help="weights of known organs: kriging or lle-template, on the registered "
            "template; lle-grid, on level sets; or lle-paper, as in the paper"
        ),
    ] = "kriging",
    neighbors: Annotated[
        int | None,
        typer.Option(
            help="number of known organs in use; default: at most 64, or 40 with "
            "lle-template, 10 with lle-paper"
        ),
    ] = None,
    leave_out: Annotated[
        list[str] | None,
        typer.Option(help="name of a known organ that gets no weight; may be repeated"),
    ] = None,
    unit: Unit = "mm",
    axes: Axes = None,
    label: Label = None,
    groups: Groups = None,
    support: Supports = None,
    vertices: Vertices = 2850,
    modes: Annotated[int, typer.Option(help="largest number of modes at a place")] = 100,
    certify: Annotated[
        int | None,
        typer.Option(
            help="number of unseen loads for the certificate; default: 24, or 200 if solved"
        ),
    ] = None,
    timings: Timings = None,
    overwrite: Overwrite = False,
) -> None:
    """Build a patient's vademecum from an atlas.

    Exit code 3: written, but not converged.
    """
    from avatar_core.atlas.base import base_of, numbers_of
    from avatar_core.atlas.patient import PatientOptions, patient_vademecum, require_fidelity
    from avatar_core.atlas.storage import load_atlas
    from avatar_core.geometry.groups import read_groups
    from avatar_core.offline.supports import SupportOption
    from avatar_core.vademecum.storage import is_vademecum, load_vademecum, save_vademecum

    require_fidelity(fidelity)
    require(weighting in WEIGHTINGS, f"--weighting is {weighting}; choose {', '.join(WEIGHTINGS)}")
    require(modes >= 1, f"--modes is {modes}; ask for at least 1")
    require(neighbors is None or neighbors >= 1, f"--neighbors is {neighbors}; ask for at least 1")
    refuse_for_phantom(ctx, surface)
    inputs = (None if surface == "phantom" else surface, atlas, groups)
    require_output(output, [".h5"], inputs, is_vademecum, overwrite)
    require_timings(timings, inputs)
    supports = tuple(SupportOption.parse(text) for text in support or ())
    points = None if groups is None else read_groups(groups)
    clock = StageClock()
    clock.begin("atlas")
    base = base_of(load_atlas(atlas))
    clock.begin("surface")
    options = PatientOptions(
        n_vertices=vertices,
        weighting=weighting,  # type: ignore[arg-type]
        n_neighbors=neighbors,
        tolerance=tolerance,
        max_modes=modes,
        n_certified=certify,
        leave_out=numbers_of(base, leave_out or ()),
        groups=points,
        supports=supports,
    )
    organ = read_organ(surface, unit, axes, label)
    with stage_bar() as progress:
        report = clock.following(progress)
        found = patient_vademecum(organ, base, fidelity, options, report)  # type: ignore[arg-type]
    clock.begin("save")
    save_vademecum(found.vademecum, output)
    clock.begin("show")
    show_text(load_vademecum(output))
    _show_origin(found)
    show_timings(clock, timings)
    if fidelity != "interpolated" and not found.vademecum.convergence.converged:
        print(
            "avatar: not converged; the file is complete, and marked as not converged; choose "
            "--fidelity solved or a larger --tolerance",
            file=sys.stderr,
        )
        raise typer.Exit(EXIT_NOT_CONVERGED)


def _show_origin(found: Patient) -> None:
    """Print neighbors, weights and time, and notices to standard error."""
    nearest = ", ".join(
        f"{name} {weight:+.3f}"
        for name, weight in zip(found.neighbors[:5], found.weights[:5], strict=True)
    )
    more = f" and {len(found.weights) - 5} more" if len(found.weights) > 5 else ""
    print(f"  from {nearest}{more}; sum |w| {found.barycenter.absolute_sum:.2f}")
    if found.estimates:
        last = found.estimates[-1]
        print(
            f"  estimated error over all loads {last.mean:.2%} mean, {last.worst:.2%} worst, "
            f"{last.solutions} fine solutions"
        )
    s = found.seconds
    print(
        f"  CPU time: registration {s.registration:.1f} s, mesh {s.mesh:.1f} s, response "
        f"{s.response:.1f} s, certificate {s.certificate:.1f} s"
    )
    say_notices(found.notices)
