"""Texts of the planning page about the state of the cell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avatar_core.scene.file import read_scene, shipped_scenes
from avatar_core.scene.recording import Recording
from avatar_ros.loop.statuses import EXPLANATIONS, explanation
from avatar_ros.msg import ContactState
from avatar_ros.ui.requests import START
from avatar_ros.ui.shown_period import ShownPeriod

_MANY_MISSED = 0.02  # part of the periods that may come late without a word
SHOWN_FORCE = 0.01  # smallest difference that is written [N]
BAND = "90 % of what is known of the material"
NO_ORGAN = "no organ yet: choose a vademecum under Organ"


def warnings(
    missing: Sequence[str], has_organ: bool, status: int | None, missed: float = 0.0
) -> str:
    """Everything that keeps the page from working, one line each; a single one if nothing does.

    status : of the last ContactState; None if none came lately
    missed : part of the loop's periods that came late, of the last second
    """
    lines = [START[name] for name in missing if name != "patient_interpolation"]
    if not has_organ and "vademecum_loader" not in missing:
        lines.append(NO_ORGAN)
    if "contact" not in missing and status is None:
        lines.append("the contact node does not answer yet")
    if "contact" not in missing and status in EXPLANATIONS:
        lines.append(explanation(status))
    if "contact" not in missing and missed > _MANY_MISSED:
        whole = "" if lines else "all nodes answer, but "
        lines.append(f"{whole}{missed:.0%} of the periods come late; close other programs")
    if not lines:
        engaging = status == ContactState.STATUS_ENGAGING
        return "All nodes answer." + (" The force is being faded in." if engaging else "")
    return "\n".join(f"⚠ {_sentence(line)}" for line in lines)


def _sentence(line: str) -> str:
    """With a capital letter, and one mark at its end."""
    return f"{line[0].upper()}{line[1:].rstrip('.')}" + ("" if line.endswith("?") else ".")


def frame_text(shown: ShownPeriod, material: str, n_kept: int | None) -> list[str]:
    """The numbers of a frame, as lines of HTML.

    material : that is in force; n_kept : recorded periods, or None
    """
    force = float(np.linalg.norm(shown.force))
    error = f"± {shown.error:.2f} N" if np.isfinite(shown.error) else "(error unknown)"
    numbers = f"<b>{force:.2f} N</b> {error}"
    moved = f"<b>{1e3 * shown.largest:.1f} mm</b>"
    if shown.is_held:
        lines = [f"No force. In grey, the last valid shape: {numbers}, {moved}"]
    elif shown.missing:
        lines = ["No force, no displacement"]
    else:
        less = force * (1.0 - shown.fraction) >= SHOWN_FORCE
        device = f", device {force * shown.fraction:.2f} N" if less else ""
        lines = [f"Force {numbers}{device}"]
        if shown.band is not None:
            low, high = shown.band
            lines.append(f"{low:.2f} to {high:.2f} N: {BAND}")
        if np.isnan(shown.largest):
            lines.append("No displacement: the contact node sends no surface")
        else:
            lines.append(f"Largest displacement {moved}")
    lines.append(material)
    if n_kept is not None:
        lines.append(f"Recording, {n_kept:,} periods")
    return lines


def plain(line: str) -> str:
    """A line without its marks of HTML."""
    return line.replace("<b>", "").replace("</b>", "")


def recorded_text(recording: Recording) -> str:
    """How much of the time was recorded."""
    n, lost = len(recording.periods), int(recording.periods.lost.sum())
    expected = round(recording.seconds * recording.rate) + 1
    late = max(expected - n - lost, 0)
    text = f"recorded {recording.seconds:.1f} s, {n:,} of {expected:,} periods"
    reasons = [f"{late:,} came late in the loop" * (late > 0), f"{lost:,} lost" * (lost > 0)]
    why = ", ".join(filter(None, reasons))
    return f"{text} ({why})" if why else text


def scene_texts() -> dict[str, str]:
    """The descriptions of the shipped scenes for one tool, with their effects, as Markdown."""
    texts = {}
    for name, path in shipped_scenes().items():
        scene = read_scene(path)
        if len(scene.tools) == 1:
            effects = "\n".join(f"- **{e.name}**: {e.text}" for e in scene.effects)
            texts[name] = f"{scene.text}\n\n{effects or '- no effects'}"
    return texts
