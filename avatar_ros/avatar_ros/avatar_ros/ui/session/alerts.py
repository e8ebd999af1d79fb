"""Alerts of the planning page: numbers with a caveat."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from avatar_core.fem.elasticity import Material
from avatar_core.vademecum.record import VademecumInfo
from avatar_interfaces.msg import ContactState
from avatar_ros.ui.session.shown_period import ShownPeriod
from avatar_ros.ui.session.texts import of_tools

LARGE_ERROR = 0.10  # expected error of displacement or force from which a patient is marked


def alerts(
    info: VademecumInfo,
    given: Collection[str],
    shown: Sequence[ShownPeriod],
    labels: Sequence[str] = ("",),
) -> list[str]:
    """Return the alerts, one line each; none if the numbers need no caveat.

    given : coordinates of the material that somebody chose
    labels : labels of the tools, each of which has a period in ``shown``
    """
    return [*alerts_of_organ(info, given), *of_tools(map(_of_period, shown), labels)]


def alerts_of_organ(info: VademecumInfo, given: Collection[str]) -> list[str]:
    """Return the alerts of an organ, whatever touches it; ``given`` as in :func:`alerts`."""
    found = []
    if "young" not in given and info.young_modulus == Material().young_modulus:
        found.append(
            f"Young's modulus is assumed: {info.young_modulus / 1e3:g} kPa, as in the paper. The "
            "force is proportional to it: choose a tissue under Organ, or calibrate"
        )
    errors = {"displacement": info.l2_mean, "force": info.force_mean}
    large = " and ".join(what for what, error in errors.items() if error >= LARGE_ERROR)
    if not np.isfinite(info.l2_mean):
        found.append("Errors of this organ were never measured: build it with a certificate")
    elif large:
        found.append(f"Large expected error of {large}: build this patient as reduced or solved")
    return found


def alerts_of_switch(
    switching: tuple[str, float] | None, in_force: str, records: bool
) -> list[str]:
    """Return the alert that a scene is being prepared, which may take minutes.

    switching : its name, and for how long [s]; in_force : name of the scene that runs
    records : whether a recording was requested
    """
    if switching is None:
        return []
    name, seconds = switching
    then = "the recording begins after it" if records else f"still in force: {in_force}"
    return [f"Scene {name} is being prepared, {seconds:.0f} s; {then}"]


def _of_period(shown: ShownPeriod) -> list[str]:
    if shown.missing:
        return [f"No force: {shown.missing}"]
    if shown.status == ContactState.STATUS_EXTRAPOLATED:
        return ["Extrapolated: beyond the computed range; do not rely on the force"]
    return []
