"""``avatar study NAME``: the experiments of the paper and ours, as table, JSON and picture."""

from __future__ import annotations

import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from avatar_core.errors import StorageError

STUDIES = {
    "meshes": "avatar_core.studies.meshes",
    "grid": "avatar_core.studies.grid",
    "in-silico": "avatar_core.studies.in_silico",
    "samples": "avatar_core.studies.samples",
    "leave-one-out": "avatar_core.studies.leave_one_out",
    "transport": "avatar_core.studies.transport",
    "pgd": "avatar_core.studies.pgd",
    "coordinates": "avatar_core.studies.coordinates",
    "certainty": "avatar_core.studies.certainty",
    "accuracy-time": "avatar_core.studies.accuracy_time",
    "passivity": "avatar_core.studies.passivity",
    "contact": "avatar_core.studies.contact",
    "indentation": "avatar_core.studies.indentation",
    "registration": "avatar_core.studies.registration",
}
USAGE = 2


def study(
    name: Annotated[str, typer.Argument(help=f"one of {', '.join(STUDIES)}")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="folder to write NAME.json and NAME.png to")
    ],
    surfaces: Annotated[
        Path | None,
        typer.Option(
            help="folder of liver surfaces [mm]; default: ../shared/data/livers, or without it "
            "generated ones, where a study can do with them"
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="smaller version that takes minutes")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="go on with an interrupted meshes or transport study")
    ] = False,
) -> None:
    """Measure what avatar claims, or repeat an experiment of the paper beside its figures."""
    from avatar_core.studies.study import write_study

    if name not in STUDIES:
        print(f"avatar: no study '{name}'; choose one of {', '.join(STUDIES)}", file=sys.stderr)
        raise typer.Exit(USAGE)
    _require_folder(output)
    if not resume:
        (output / f"{name}.rows.jsonl").unlink(missing_ok=True)
    run = import_module(STUDIES[name]).run
    start = time.perf_counter()
    found = run(surfaces, quick, output)
    seconds = time.perf_counter() - start
    for notice in found.notices:
        print(f"notice: {notice}", file=sys.stderr)
    print(found.table())
    print(found.sentence)
    record, picture = write_study(found, output, seconds)
    print(f"{record}\n{picture}  ({seconds:.0f} s)")


def _require_folder(output: Path) -> None:
    """Raise StorageError before the study runs, not hours later."""
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot write into {output} ({error}); give another folder") from error
