"""Texts of the planning page about the state of the cell."""

from __future__ import annotations

from collections.abc import Sequence

from avatar_core.scene.file import read_scene, shipped_scenes
from avatar_ros.loop.statuses import EXPLANATIONS, explanation
from avatar_ros.msg import ContactState
from avatar_ros.ui.requests import START

_SHOWN_FORCE = 0.01  # smallest difference that is written [N]
NO_ORGAN = "no organ yet: choose a vademecum under Organ"


def warnings(missing: Sequence[str], has_organ: bool, status: int | None) -> str:
    """Everything that keeps the page from working, as Markdown; one line if nothing does.

    status : of the last ContactState; None if none came lately
    """
    lines = [START[name] for name in missing if name != "patient_interpolation"]
    if not has_organ and "vademecum_loader" not in missing:
        lines.append(NO_ORGAN)
    if "contact" not in missing and status is None:
        lines.append("the contact node does not answer yet")
    if "contact" not in missing and status in EXPLANATIONS:
        lines.append(explanation(status))
    if not lines:
        engaging = status == ContactState.STATUS_ENGAGING
        return "**All nodes answer.**" + (" The force is being faded in." if engaging else "")
    return "\n\n".join(f"⚠ {line[0].upper()}{line[1:]}." for line in lines)


def frame_text(
    force: float, error: float, fraction: float, largest: float, n_kept: int | None
) -> str:
    """What a frame shows, as Markdown.

    Parameters
    ----------
    force, error : of the organ [N]
    fraction : of the force that the device gets; less while it is limited or faded in or out
    largest : displacement [m]
    n_kept : recorded periods, or None
    """
    recorded = "" if n_kept is None else f"; recording, {n_kept} periods"
    less = force * (1.0 - fraction) >= _SHOWN_FORCE
    device = f", **limited: the device gets {force * fraction:.2f} N**" if less else ""
    return (
        f"Force **{force:.2f} N** ± {error:.2f} N{device}, largest displacement "
        f"**{1e3 * largest:.1f} mm**{recorded}"
    )


def scene_texts() -> dict[str, str]:
    """The descriptions of the shipped scenes for one tool, with their effects, as Markdown."""
    texts = {}
    for name, path in shipped_scenes().items():
        scene = read_scene(path)
        if len(scene.tools) == 1:
            effects = "\n".join(f"- **{e.name}**: {e.text}" for e in scene.effects)
            texts[name] = f"{scene.text}\n\n{effects or '- no effects'}"
    return texts
