"""``avatar study NAME``: the experiments of the paper and ours, as table, JSON and picture."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from avatar_core.cli.unused import refuse
from avatar_core.cli.vademecum import say_notices
from avatar_core.errors import StorageError
from avatar_core.studies import NAMES, load_study

USAGE = 2


def study(
    ctx: typer.Context,
    name: Annotated[str, typer.Argument(help=f"one of {', '.join(NAMES)}")],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="folder to write NAME.json and NAME.png to")
    ],
    surfaces: Annotated[
        Path | None,
        typer.Option(
            help="folder of liver surfaces [mm]; default: ../shared/data/livers, or "
            "generated livers if a study can use them"
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="smaller version that takes minutes")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="go on with an interrupted meshes or transport study")
    ] = False,
) -> None:
    """Run a study of avatar or of the paper.

    A study measures a claim of avatar, or repeats an experiment of the paper beside its figures.
    """
    if name not in NAMES:
        print(f"avatar: no study '{name}'; choose one of {', '.join(NAMES)}", file=sys.stderr)
        raise typer.Exit(USAGE)
    chosen = load_study(name)
    if not chosen.key:
        refuse(ctx, ("resume",), f"for studies that keep their rows, and {name} keeps none")
    _require_folder(output)
    if not resume:
        (output / f"{name}.rows.jsonl").unlink(missing_ok=True)
    start = time.perf_counter()
    run = chosen.conduct(chosen.quick if quick else chosen.full, output, surfaces)
    seconds = time.perf_counter() - start
    say_notices(run.notices)
    print(run.table())
    print(run.sentence)
    record, picture = run.write(seconds)
    print(f"{record}\n{picture}  ({seconds:.0f} s)")


def _require_folder(output: Path) -> None:
    """Raise StorageError before the study runs, not hours later."""
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"cannot write into {output} ({error}); give another folder") from error
