"""``avatar replay``: compute the forces along a recording or a bag again."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from avatar_core.cli.numbers import ToolTransform, pose_of
from avatar_core.cli.progress import progress_bar
from avatar_core.cli.unused import refuse
from avatar_core.cli.vademecum import require

if TYPE_CHECKING:
    import numpy as np

    from avatar_core.bags.read import Bag
    from avatar_core.haptics.force_guard import ForceLimits
    from avatar_core.scene.recording import Recording
    from avatar_core.scene.replay import Replayed
    from avatar_core.vademecum.model import Vademecum

_SAME_CODE = "replay with the version of avatar, and on the kind of processor, that recorded"
_SAME_CELL = f"give --scene, --tool-transform and --device of the cell, and {_SAME_CODE}"


def replay(
    ctx: typer.Context,
    file: Annotated[
        Path,
        typer.Argument(
            help="recording of the planning page (.h5), or a bag of ROS 2: its folder, .mcap or "
            ".db3"
        ),
    ],
    vademecum: Annotated[Path, typer.Option(help="vademecum with which it was recorded (.h5)")],
    tolerance: Annotated[
        float, typer.Option(help="largest permitted difference of a force [N]")
    ] = 1e-9,
    tool: Annotated[
        str | None,
        typer.Option(help="for a bag of several tools: NAME in the topics NAME/measured_cp"),
    ] = None,
    scene: Annotated[
        str | None,
        typer.Option(
            help="for a bag: scene that ran, a file or the name of a shipped scene; default: "
            "a sphere of 5 mm and the effects that the vademecum requires"
        ),
    ] = None,
    tool_transform: ToolTransform = None,
    rate: Annotated[
        float | None,
        typer.Option(
            help="for a bag: rate of the contact loop [Hz]; default: the rate of its answers"
        ),
    ] = None,
    device: Annotated[
        str,
        typer.Option(
            help="for a bag without contact_state: safety.device of the contact node (touch, "
            "omega or sigma), whose limits the forces kept"
        ),
    ] = "sigma",
) -> None:
    """Compute the forces of a recording again.

    They are compared with the recorded ones.
    """
    from avatar_core.bags.files import is_bag
    from avatar_core.haptics.force_guard import DEVICES

    require(rate is None or 100.0 <= rate <= 2000.0, f"--rate is {rate} Hz; give 100 to 2000")
    require(device in DEVICES, f"--device is {device}; choose {', '.join(DEVICES)}")
    transform = pose_of(tool_transform)
    if is_bag(file):
        how = _How(tool, scene, transform, rate, DEVICES[device])
        _replay_bag(file, vademecum, how, tolerance)
    else:
        use = "for bags, and this is a recording of the page, which holds its scene"
        refuse(ctx, ("tool", "scene", "tool_transform", "rate", "device"), use)
        _replay_recording(file, vademecum, tolerance)


def _replay_recording(file: Path, vademecum: Path, tolerance: float) -> None:
    from avatar_core.scene.recording import load_recording
    from avatar_core.scene.replay import replay, why_not
    from avatar_core.vademecum.storage import load_vademecum

    recording = load_recording(file)
    organ = load_vademecum(vademecum)
    with progress_bar("periods") as progress:
        found = replay(recording, organ, progress)
    _say(recording, recording.periods.force)
    _compare(file, recording, found, why_not(recording), tolerance, _SAME_CODE)


class _How(NamedTuple):
    """Settings of reading a bag; see the options of the command."""

    tool: str | None
    scene: str | None
    transform: tuple[float, ...] | None
    rate: float | None
    limits: ForceLimits


def _replay_bag(file: Path, vademecum: Path, how: _How, tolerance: float) -> None:
    from avatar_core.bags.compare import comparable, why_not
    from avatar_core.bags.periods import path_of
    from avatar_core.bags.read import read_bag
    from avatar_core.scene.replay import replay
    from avatar_core.vademecum.storage import load_vademecum

    organ = load_vademecum(vademecum)
    with progress_bar("messages") as progress:
        bag = read_bag(file, how.tool, progress)
    identity = _identity(bag, organ)
    path = path_of(bag, _scene_of(bag, how.scene, organ), organ.id, how.transform, how.rate)
    with progress_bar("periods") as progress:
        replayed = replay(path.recording, organ, progress)
    recorded = path.answers != "poses"
    _say(path.recording, path.recording.periods.force if recorded else replayed.force)
    for note in (_COMPARED[path.answers], *identity, *bag.notes, *path.notes):
        print(f"  {note}")
    if recorded:
        found = comparable(path, replayed, how.limits)
        _compare(file, path.recording, found, why_not(path), tolerance, _SAME_CELL)


_COMPARED = {
    "states": "compared with the computed forces, from contact_state",
    "wrenches": "no contact_state: compared with the wrenches where no limit or fault alters them",
    "poses": "no forces in the bag: those above are computed, and compared with nothing",
}


def _identity(bag: Bag, organ: Vademecum) -> list[str]:
    """Refuse another vademecum than the bag names; return notes about the bag's vademecums."""
    ids = bag.vademecum_ids
    if not ids:
        return ["no vademecum_info in the bag: whether it was made with this vademecum is unknown"]
    require(
        organ.id in ids,
        f"{bag.path} was made with the vademecum {', '.join(one[:12] for one in ids[:5])}, this is "
        f"{organ.name!r} ({organ.id[:12]}); give the one it was made with",
    )
    others = len(ids) - 1
    return [f"{others} more vademecums are named in the bag"] if others else []


def _scene_of(bag: Bag, name: str | None, organ: Vademecum) -> str:
    """Return the scene of one tool as YAML: the given one, the bag's, or the default."""
    from avatar_core.contact.layout import default_effects
    from avatar_core.geometry.tip import Tip
    from avatar_core.scene.file import read_scene, scene_path, write_scene
    from avatar_core.scene.model import Scene

    if name is None and bag.about is not None:
        return bag.about.scene
    if name is None:
        return write_scene(Scene(effects=default_effects(organ, (Tip(),))))
    scene = read_scene(scene_path(name))
    require(
        len(scene.tools) == 1,
        f"{name} has {len(scene.tools)} tools, a bag is replayed for one; give a scene of one tool",
    )
    return write_scene(scene)


def _say(recording: Recording, force: np.ndarray) -> None:
    periods, size = recording.periods, (force**2).sum(axis=2) ** 0.5
    n_clouds = len(recording.clouds.period)
    print(
        f"{recording.vademecum_name} ({recording.vademecum_id[:12]}): {len(periods)} periods, "
        f"{int(periods.lost.sum())} lost, in {recording.seconds:.1f} s (nominally "
        f"{recording.rate:g} Hz), {n_clouds} clouds"
    )
    print(f"  largest force {size.max():.3f} N, in contact {(size > 0).any(axis=1).mean():.0%}")


def _compare(
    file: Path, recording: Recording, found: Replayed, why_not: str, tolerance: float, remedy: str
) -> None:
    difference = found.difference(recording)
    require(not math.isnan(difference), f"{file}: nothing can be compared: {why_not}")
    print(
        f"  {int(found.known.sum())} periods can be compared: largest difference {difference:.2e} N"
    )
    require(
        difference <= tolerance,
        f"{file}: forces differ by {difference:.2e} N, above {tolerance:g} N; {remedy}",
    )
