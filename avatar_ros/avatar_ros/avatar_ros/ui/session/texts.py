"""Texts of the planning page about the state of the cell."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from avatar_core.scene.file import read_scene, shipped_scenes
from avatar_core.scene.model import Scene
from avatar_core.scene.recording import Recording
from avatar_interfaces.msg import ContactState
from avatar_ros.loop.statuses import EXPLANATIONS, explanation
from avatar_ros.ui.session.requests import START
from avatar_ros.ui.session.shown_period import OTHER_ORGAN, ShownPeriod

_MANY_MISSED = 0.02  # fraction of the periods that may come late without a message
BAND = "90 % range for the uncertain material"
# the error beside the force covers the reduction; material and mesh are taken as exact
COVERS = "± covers nine touches in ten, against finite elements"
# how to start a cell with this number of tools
_EXAMPLES = {
    1: "one tool (`avatar cell` without `--tools`)",
    2: "two tools (`avatar cell --tools left,right`)",
}
NO_ORGAN = "no organ yet: choose a vademecum under Organ"


def of_tools(lines: Iterable[Sequence[str]], labels: Sequence[str]) -> list[str]:
    """Return lines of each tool after its label; lines that all tools share once, without label."""
    tools: dict[str, list[str]] = {}
    for label, own in zip(labels, lines, strict=True):
        for line in own:
            tools.setdefault(line, []).append(label)
    return [
        line if len(named) == len(labels) else f"{' and '.join(named)}: {line}"
        for line, named in tools.items()
    ]


def warnings(
    missing: Sequence[str],
    has_organ: bool,
    statuses: Sequence[int],
    labels: Sequence[str] = ("",),
    missed: float = 0.0,
) -> str:
    """Return all that keeps the page from working, one line each; a single line if nothing does.

    statuses : status of each tool in the last period; empty if none came lately
    labels : labels of the tools
    missed : fraction of the loop's periods that came late in the last second
    """
    lines = [_sentence(START[name]) for name in missing if name != "patient_interpolation"]
    if not has_organ and "vademecum_loader" not in missing:
        lines.append(_sentence(NO_ORGAN))
    if "contact" not in missing and not statuses:
        lines.append(_sentence("the contact node does not answer yet"))
    elif "contact" not in missing:
        lines += of_tools((_why(status, has_organ) for status in statuses), labels)
    if "contact" not in missing and missed > _MANY_MISSED:
        whole = "" if lines else "all nodes answer, but "
        late = f"{whole}{missed:.0%} of the periods come late; close other programs"
        lines.append(_sentence(late))
    if not lines:
        engaging = ContactState.STATUS_ENGAGING in statuses
        return "All nodes answer." + (" The force is being faded in." if engaging else "")
    return "\n".join(f"⚠ {line}" for line in lines)


def _why(status: int, has_organ: bool) -> list[str]:
    """Return cause and remedy of a status in a line; none if it needs none."""
    if status == ContactState.STATUS_NO_MODEL and has_organ:
        return [_sentence(OTHER_ORGAN)]
    return [_sentence(explanation(status))] if status in EXPLANATIONS else []


def _sentence(line: str) -> str:
    """Return a line with a capital letter, and one mark at its end."""
    return f"{line[0].upper()}{line[1:].rstrip('.')}" + ("" if line.endswith("?") else ".")


def frame_text(shown: ShownPeriod, material: str, n_kept: int | None, label: str = "") -> list[str]:
    """Return the numbers of a frame, as lines of HTML.

    material : material in force; n_kept : recorded periods, or None; label : of the tool
    """
    force = float(np.linalg.norm(shown.force))
    error = f"± {shown.error:.2f} N" if np.isfinite(shown.error) else "(error unknown)"
    numbers = f"<b>{force:.2f} N</b> {error}"
    on = f" on {escape(label)}" if label else ""
    moved = f"<b>{1e3 * shown.largest:.1f} mm</b>"
    if shown.is_held:
        lines = [f"No force{on}. In grey, the last valid shape: {numbers}, {moved}"]
    elif shown.missing:
        lines = [f"No force{on}, no displacement"]
    else:
        lines = [f"Force{on} {numbers}"]
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
    if "±" in lines[0]:
        lines.append(f"<small>{COVERS}</small>")
    return lines


def plain(line: str) -> str:
    """Return a line without its HTML tags."""
    return re.sub("</?(b|small)>", "", line)


def recorded_text(recording: Recording) -> str:
    """Describe how much of the time was recorded."""
    n, lost = len(recording.periods), int(recording.periods.lost.sum())
    # with several tools the loop may step more often than at its rate: at each tool's pose
    expected = max(round(recording.seconds * recording.rate) + 1, n + lost)
    late = expected - n - lost
    text = f"recorded {recording.seconds:.1f} s, {n:,} of {expected:,} periods"
    reasons = [f"{late:,} came late in the loop" * (late > 0), f"{lost:,} lost" * (lost > 0)]
    why = ", ".join(filter(None, reasons))
    return f"{text} ({why})" if why else text


def scene_texts(n_tools: int) -> dict[str, str]:
    """Return descriptions of the shipped scenes for n tools, with their effects, as Markdown."""
    texts = {}
    for name, scene in _shipped().items():
        if len(scene.tools) == n_tools:
            effects = "\n".join(f"- **{e.name}**: {e.text}" for e in scene.effects)
            texts[name] = f"{scene.text}\n\n{effects or '- no effects'}"
    return texts


def other_scenes(n_tools: int) -> str:
    """Describe how to get the shipped scenes of other numbers of tools, as Markdown."""
    others: dict[int, list[str]] = {}
    for name, scene in _shipped().items():
        if len(scene.tools) != n_tools:
            others.setdefault(len(scene.tools), []).append(name)
    return "\n\n".join(
        f"With {_EXAMPLES.get(n, f'{n} tools')} there {'is' if len(names) == 1 else 'are'} also "
        f"{', '.join(names)}."
        for n, names in sorted(others.items())
    )


def _shipped() -> dict[str, Scene]:
    return {name: read_scene(path) for name, path in shipped_scenes().items()}
