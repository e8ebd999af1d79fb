"""``avatar scene check`` and ``avatar scene list``: content and cost of scenes."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from avatar_core.cli.progress import waiting
from avatar_core.errors import SceneError

if TYPE_CHECKING:
    from avatar_core.contact.effects import Effect
    from avatar_core.geometry.tip import Jaw, Tip
    from avatar_core.scene.model import Scene
    from avatar_core.vademecum.model import Vademecum

scene = typer.Typer(
    help="Inspect scenes: organ, tools, effects (YAML).",
    no_args_is_help=True,
    rich_markup_mode=None,  # markup would remove units like [m]
)


@scene.command("list")
def list_scenes() -> None:
    """List the shipped scenes."""
    from avatar_core.scene.file import read_scene, shipped_scenes

    shipped = shipped_scenes()
    if not shipped:
        raise SceneError(
            "the shipped scenes are missing from this installation; write a scene of your own"
        )
    for name, path in shipped.items():
        one = read_scene(path)
        print(f"{name:17s} {one.text}")
        print(f"{'':17s} effects: {', '.join(e.name for e in one.effects) or 'none'}")


@scene.command()
def check(
    file: Annotated[str, typer.Argument(help="YAML file, or name of a shipped scene")],
    vademecum: Annotated[
        Path | None,
        typer.Option(help="vademecum (.h5) to check the scene against; its step is then timed"),
    ] = None,
) -> None:
    """Show a scene, and time its step.

    The output lists its content, how its effects combine, and what a step costs.
    """
    from avatar_core.scene.file import read_scene, scene_path
    from avatar_core.vademecum.storage import load_vademecum

    path = scene_path(file)
    one = read_scene(path)
    v = None if vademecum is None else load_vademecum(vademecum)
    print(f"{one.name}{f': {one.text}' if one.text else ''}")
    print(f"  {path}")
    print(f"  organ: {_organ(one, vademecum)}; {_material(one)}")
    for tool in one.tools:
        jaw = tool.tip.grasp
        grasp = f"; jaw: {', '.join(_numbers(jaw))}" if jaw else ""
        print(f"  tool {tool.name}: {_tip(tool.tip)}{grasp}")
    print(f"  outputs: {_outputs(one)}")
    print("  effects" if one.effects else "  effects: none")
    for effect in one.effects:
        _show_effect(effect)
    _show_combinations(one, v)
    if v is None:
        print("  cost of a step: needs an organ; give --vademecum FILE.h5")
        return
    one.require(v)
    _show_cost(one, v)


def _organ(one: Scene, given: Path | None) -> str:
    if given is not None:
        return str(given)
    return f"{one.vademecum}, in the library" if one.vademecum else "whichever is loaded"


def _material(one: Scene) -> str:
    chosen = [
        f"{name} {value:g}{unit}"
        for name, value, unit in (
            ("E", one.young_modulus, " Pa"),
            ("nu", one.poisson_ratio, ""),
            ("resection", one.resection, ""),
        )
        if value is not None
    ]
    chosen += [f"support {s.name} {s.stiffness:g} N/m^3" for s in one.supports]
    return ", ".join(chosen) or "its own material"


def _tip(tip: Tip) -> str:
    """Return a tip's shape, and the numbers that the shape uses."""
    return ", ".join([tip.shape, *_numbers(tip)])


def _numbers(one: Tip | Jaw) -> list[str]:
    return [
        f"{field.name} {_number(value, field.metadata['quantity'].unit)}"
        for field in fields(one)
        if "quantity" in field.metadata and (value := getattr(one, field.name)) is not None
    ]


def _outputs(one: Scene) -> str:
    if one.cloud == "off":
        return "forces and contacts every step, no cloud"
    every = "every step" if one.cloud_divisor == 1 else f"every {one.cloud_divisor} steps"
    modes = "all modes" if one.modes is None else f"{one.modes} modes"
    return f"forces and contacts every step, cloud of the {one.cloud} {every} with {modes}"


def _show_effect(effect: Effect) -> None:
    """Print the effect, then every number with unit and meaning."""
    print(f"    {effect.name:18s} {effect.text}")
    for field in fields(effect):
        meant = field.metadata["quantity"]
        value = _number(getattr(effect, field.name), meant.unit)
        print(f"      {field.name:16s} {value:15s} {meant.text}")


def _number(value: Any, unit: str) -> str:
    if value is None:
        return "the file's"
    several = value if isinstance(value, tuple) else (value,)
    text = ", ".join(f"{number:g}" for number in several)
    return text if unit == "-" else f"{text} {unit}"


def _show_combinations(one: Scene, v: Vademecum | None) -> None:
    """Print how the effects combine, and with what error."""
    from avatar_core.scene.model import combinations

    found = combinations(one, v)
    if found:
        hint = "" if v else "; for the error of it, give --vademecum FILE.h5"
        print(f"  combined (the others superpose){hint}")
    elif len(one.effects) > 1:
        print("  combined: all superpose")
    for pair in found:
        print(f"    {' with '.join(pair.effects)}: {pair.how}")
        if v is not None:
            measured = "not measured in this file"
            if pair.error is not None:
                measured = f"mean error {pair.error:.1%}"
            print(f"      {measured}")


def _show_cost(one: Scene, v: Vademecum) -> None:
    """Time the scene's step on this machine."""
    from avatar_core.studies.bench.methods import load_average
    from avatar_core.studies.bench.scene import DEPTH, PUSH, time_scene

    rows = time_scene(v, one, waiting)
    print(
        f"  cost of a step here and now (load average {load_average():.2f}): a push of "
        f"{PUSH * 1e3:g} mm and a slide {DEPTH * 1e3:g} mm deep;\n"
        "  of the steps in which all tools touch, each with its cloud"
    )
    print(
        f"    {'':22s} {'p50 us':>8s} {'p99 us':>8s} {'steps':>7s} {'model MB':>9s} "
        f"{'laid out s':>10s}"
    )
    names = {"bare": "bare: one tool, alone", "scene": "this scene"}
    for row in rows:
        print(
            f"    {names[row.name]:22s} {row.p50_us:8.1f} {row.p99_us:8.1f} {row.n_steps:7d} "
            f"{row.bytes / 1e6:9.1f} {row.layout_seconds:10.2f}"
        )
    if not one.effects:
        print("    (without effects, this scene is the bare step)")
