"""``avatar replay``: compute a recording of the planning page again."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from avatar_core.errors import AvatarError


def replay(
    file: Annotated[Path, typer.Argument(help="recording of the planning page (.h5)")],
    vademecum: Annotated[Path, typer.Option(help="vademecum with which it was recorded (.h5)")],
    tolerance: Annotated[
        float, typer.Option(help="largest permitted difference of a force [N]")
    ] = 1e-9,
) -> None:
    """Compute the forces along a recorded path again, and compare them with the recorded ones."""
    from avatar_core.scene.recording import load_recording
    from avatar_core.scene.replay import replay as replayed
    from avatar_core.scene.replay import why_not
    from avatar_core.vademecum.storage import load_vademecum

    recording = load_recording(file)
    found = replayed(recording, load_vademecum(vademecum))
    periods = recording.periods
    size = (periods.force**2).sum(axis=2) ** 0.5
    print(
        f"{recording.vademecum_name} ({recording.vademecum_id[:12]}): {len(periods)} periods, "
        f"{int(periods.lost.sum())} lost, in {recording.seconds:.1f} s (nominally "
        f"{recording.rate:g} Hz), {len(recording.clouds.period)} clouds"
    )
    print(f"  largest force {size.max():.3f} N, in contact {(size > 0).any(axis=1).mean():.0%}")
    difference = found.difference(recording)
    if math.isnan(difference):
        raise AvatarError(f"{file}: nothing can be compared: {why_not(recording)}")
    print(
        f"  {int(found.known.sum())} periods can be compared: largest difference {difference:.2e} N"
    )
    if difference > tolerance:
        raise AvatarError(
            f"{file}: forces differ by {difference:.2e} N, above {tolerance:g} N; replay with the "
            "version of avatar, and on the kind of processor, that recorded"
        )
