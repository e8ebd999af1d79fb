"""What the planning page says of the cell's state, in plain words."""

from __future__ import annotations

from collections.abc import Sequence

from avatar_core.scene.file import read_scene, shipped_scenes
from avatar_ros.msg import ContactState
from avatar_ros.ui.requests import START

NO_ORGAN = "no organ yet: choose a vademecum under Organ"
_STATUS = {
    ContactState.STATUS_NO_MODEL: "the contact node has no organ yet",
    ContactState.STATUS_NO_POSE: "the tool's poses do not arrive yet",
    ContactState.STATUS_STALE_POSE: "the tool's poses come too late: is the machine too busy?",
    ContactState.STATUS_INVALID_POSE: "the tool's pose is broken",
    ContactState.STATUS_NOT_CONVERGED: "the contact was not solved to the end",
    ContactState.STATUS_OUT_OF_RANGE: "the tool is where this organ has no answer: "
    "too deep, or off the accessible surface; lift it off the organ",
    ContactState.STATUS_UNKNOWN_FRAME: "the contact node expects poses in another frame: "
    "leave its parameter tool_frame empty to use the mouse",
    ContactState.STATUS_EXTRAPOLATED: "pushed deeper than this organ was computed for; "
    "the force goes on straight",
    ContactState.STATUS_LEAP: "the tool leapt; its force comes back in a moment",
    ContactState.STATUS_SEVERAL_PUBLISHERS: "another program moves this tool, too: end one of them",
    ContactState.STATUS_LOST_TOOL: "the tool's poses stopped",
    ContactState.STATUS_INACTIVE: "the contact node is being stopped",
}


def warnings(missing: Sequence[str], has_organ: bool, status: int | None) -> str:
    """All that keeps the page from working, as Markdown; one line if nothing does.

    status : of the last ContactState; None if none came lately
    """
    lines = [START[name] for name in missing if name != "patient_interpolation"]
    if not has_organ and "vademecum_loader" not in missing:
        lines.append(NO_ORGAN)
    if "contact" not in missing and status is None:
        lines.append("the contact node does not answer yet")
    if "contact" not in missing and status in _STATUS:
        lines.append(_STATUS[status])
    if not lines:
        engaging = status == ContactState.STATUS_ENGAGING
        return "**All nodes answer.**" + (" The force comes back softly." if engaging else "")
    return "\n\n".join(f"⚠ {line[0].upper()}{line[1:]}." for line in lines)


def frame_text(force: float, error: float, largest: float, n_kept: int | None) -> str:
    """Force and how wrong it may be [N], largest displacement [m]; periods recorded, or None."""
    recorded = "" if n_kept is None else f"; recording, {n_kept} periods"
    return (
        f"Force **{force:.2f} N** ± {error:.2f} N, largest displacement "
        f"**{1e3 * largest:.1f} mm**{recorded}"
    )


def scene_texts() -> dict[str, str]:
    """What each shipped scene for one tool says of itself, with its effects, as Markdown."""
    texts = {}
    for name, path in shipped_scenes().items():
        scene = read_scene(path)
        if len(scene.tools) == 1:
            effects = "\n".join(f"- **{e.name}**: {e.text}" for e in scene.effects)
            texts[name] = f"{scene.text}\n\n{effects or '- no effects'}"
    return texts
