"""What must not be missed on the planning page: numbers that are not what they seem."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from avatar_core.vademecum.model import VademecumInfo
from avatar_ros.msg import ContactState
from avatar_ros.ui.shown_period import ShownPeriod
from avatar_ros.ui.texts import SHOWN_FORCE, of_tools

LARGE_ERROR = 0.10  # expected of the displacement or the force, from which a patient is marked


def alerts(
    info: VademecumInfo, shown: Sequence[ShownPeriod], labels: Sequence[str] = ("",)
) -> list[str]:
    """One line each; none if the numbers are what they seem.

    labels : of the tools, each of which has a period in ``shown``
    """
    return [*alerts_of_organ(info), *of_tools(map(_of_period, shown), labels)]


def alerts_of_organ(info: VademecumInfo) -> list[str]:
    """What must not be missed of an organ, whatever touches it."""
    errors = {"displacement": info.l2_mean, "force": info.force_mean}
    if not np.isfinite(info.l2_mean):
        return ["Errors of this organ were never measured: build it with a certificate"]
    large = [
        f"{what} {error:.0%}"
        for what, error in errors.items()
        if np.isfinite(error) and error >= LARGE_ERROR
    ]
    if not large:
        return []
    return [f"Large expected error: {', '.join(large)}. Build this patient as reduced or solved"]


def _of_period(shown: ShownPeriod) -> list[str]:
    if shown.missing:
        return [f"No force: {shown.missing}"]
    lines = []
    if shown.status == ContactState.STATUS_EXTRAPOLATED:
        lines.append("Extrapolated: pressed beyond what was computed; the force is a guess")
    force = float(np.linalg.norm(shown.force))
    got = force * shown.fraction
    is_engaging = shown.status == ContactState.STATUS_ENGAGING
    if not is_engaging and force - got >= SHOWN_FORCE:
        lines.append(f"Force limited: the device gets {got:.2f} N of {force:.2f} N")
    return lines
