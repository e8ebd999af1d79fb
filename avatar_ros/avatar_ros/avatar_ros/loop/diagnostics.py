"""Diagnostics of the contact node: levels, texts and numbers for `/diagnostics`.

The hardware id of a tool is the namespace of its driver, such as ``/MTML``, and else the host.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from avatar_core.contact.status import Status
from avatar_core.haptics.force_guard import ForceGuard
from avatar_core.haptics.passivity import Passivity
from avatar_interfaces.msg import LoopStatistics
from avatar_ros.framework.ports import ONE_CELL
from avatar_ros.loop.device import OF_DEVICE
from avatar_ros.loop.statuses import EXPLANATIONS, explanation
from avatar_ros.loop.tool_channel import ToolChannel

# faults that do not set the force to zero
_WITH_FORCE = (Status.NOT_CONVERGED, Status.EXTRAPOLATED)
OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


@dataclass(frozen=True)
class Faults:
    """Faults of one tool in a window: how often each status was entered, and the present one.

    Attributes
    ----------
    said : str
        Operating state of its device, in words; empty if the device is not heard or silent.
    senders : tuple of str
        Names of the nodes that send its poses.
    """

    counts: dict[int, int]
    status: int
    said: str = ""
    senders: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """Return cause and remedy in one line; empty without a fault."""
        status, said = self.status, self.said
        if status not in EXPLANATIONS:
            said = ""  # the device says something else now
            entered = [key for key in self.counts if key in EXPLANATIONS]
            status = max(entered, key=lambda key: self.counts[key], default=int(Status.OK))
        if status not in EXPLANATIONS:
            return ""
        detail = f"it says {said}" if said and status in OF_DEVICE else ""
        if status == Status.SEVERAL_PUBLISHERS:
            detail = ", ".join(self.senders)
        force = "" if status in _WITH_FORCE else "no force: "
        return f"{force}{explanation(status)}{f' ({detail})' if detail else ''}"


class FaultCounter:
    """Counter of the faults of each tool between two calls."""

    def __init__(self, tools: Sequence[ToolChannel]) -> None:
        self._tools = tools
        self._seen = [tool.faults.copy() for tool in tools]

    def window(self) -> list[Faults]:
        """Return the faults of each tool since the last call."""
        found = []
        for i, tool in enumerate(self._tools):
            now = tool.faults.copy()
            new = now - self._seen[i]
            self._seen[i] = now
            counts = {int(k): int(new[k]) for k in np.flatnonzero(new) if k != 0}
            status = tool.fault if tool.fault != Status.OK else tool.solved
            senders = tuple(tool.senders.values())
            found.append(Faults(counts, status, tool.operating_state, senders))
        return found


def loop_status(
    name: str, window: LoopStatistics, nominal: float, limits: dict[str, float]
) -> DiagnosticStatus:
    """Return the status of the loop's rate and step; ``limits``: values of ``THRESHOLDS``."""
    missed = window.missed / max(window.periods, 1)
    measured = {
        "periodicity.mean_error": abs(window.rate - nominal),
        "execution_time.mean": 1e6 * window.compute_mean,
        "missed": missed,
    }
    level, broken = OK, []
    for key, value in measured.items():
        if value > limits[f"diagnostics.{key}.error"]:
            level = ERROR
        elif value > limits[f"diagnostics.{key}.warn"]:
            level = max(level, WARN)
        else:
            continue
        broken.append(key)
    text = f"{window.rate:.1f} Hz of {nominal:g}, {missed:.2%} of the periods missed"
    if broken:
        text += (
            f": beyond the threshold of {', '.join(broken)}; give the loop realtime.priority and "
            "realtime.cpu, or the machine less to do"
        )
    return _status(
        f"{name}: loop",
        level,
        text,
        {
            "rate [Hz]": window.rate,
            "periods": window.periods,
            "missed": window.missed,
            "period mean [us]": 1e6 / window.rate if window.rate else float("nan"),
            "period p99 [us]": 1e6 * window.period_p99,
            "period max [us]": 1e6 * window.period_max,
            "execution mean [us]": 1e6 * window.compute_mean,
            "execution p99 [us]": 1e6 * window.compute_p99,
            "execution max [us]": 1e6 * window.compute_max,
            "pose age p50 [us]": 1e6 * window.pose_age_p50,
            "pose age p99 [us]": 1e6 * window.pose_age_p99,
        },
    )


def tool_status(
    name: str,
    tool_name: str,
    tool: ToolChannel,
    guard: ForceGuard,
    faults: Faults,
    energies: Passivity | None,
    i: int,
) -> DiagnosticStatus:
    """Return the status of one tool: faults, force limits, and energies if they are observed."""
    values: dict[str, Any] = {
        "publishers of poses": tool.publishers,
        "fraction of the force sent": guard.sent_fraction,
        "limited": guard.limited,
        "largest force [N]": guard.limits.force,
        "largest slew [N/s]": guard.limits.slew,
    }
    if tool.operating_state:
        values["operating state"] = tool.operating_state
    values |= {f"status {key} entered": count for key, count in faults.counts.items()}
    if energies is not None:
        values["energy put in by the tool [mJ]"] = 1e3 * float(energies.energy[i])
        values["energy made by hold and delay [mJ]"] = 1e3 * float(energies.created[i])
    text, level = faults.text, WARN
    if not text and guard.limited:
        text = f"force limited to {guard.limits.force:g} N and {guard.limits.slew:g} N/s"
    elif not text:
        text, level = "poses valid, full force sent", OK
    hardware = tool.subscription.topic_name.rpartition("/")[0]
    return _status(f"{name}: {tool_name}", level, text, values, hardware)


def vademecum_status(name: str, identity: str, accuracy: str) -> DiagnosticStatus:
    """Return the status of the loaded vademecum, with its certified errors."""
    if not identity:
        return _status(f"{name}: vademecum", WARN, "none: no force; load one", {})
    return _status(f"{name}: vademecum", OK, accuracy, {"id": identity})


def cells_status(name: str, rivals: Sequence[str]) -> DiagnosticStatus:
    """Return the status of topics that another cell also publishes; ``rivals``: a line each."""
    if not rivals:
        return _status(f"{name}: other cells", OK, "none was found", {})
    return _status(f"{name}: other cells", ERROR, f"{'; '.join(rivals)}: {ONE_CELL}", {})


def qos_status(name: str, mismatches: list[str]) -> DiagnosticStatus:
    """Return the status of incompatible ends in other nodes; ``mismatches``: a line each."""
    text = "; ".join(mismatches)
    if not text:
        return _status(f"{name}: quality of service", OK, "no mismatched end was found", {})
    return _status(
        f"{name}: quality of service",
        WARN,
        f"{text}: change theirs, or qos_overrides.* here",
        {"ends not matched": len(mismatches)},
    )


def accuracy_status(name: str, text: str, shedding: bool, window: LoopStatistics) -> Any:
    """Return the status of the shown modes, their certified errors and measured times."""
    return _status(
        f"{name}: accuracy",
        WARN if shedding else OK,
        text,
        {
            "modes shown": window.modes_shown,
            "modes": window.modes,
            "displacement within": window.promised_l2,
            "force within": window.promised_force,
            "step p99 [us]": 1e6 * window.step_p99,
        },
    )


def _status(
    name: str, level: bytes, text: str, values: dict[str, Any], hardware: str = ""
) -> DiagnosticStatus:
    shown = [
        KeyValue(key=key, value=f"{value:.6g}" if isinstance(value, float) else str(value))
        for key, value in values.items()
    ]
    return DiagnosticStatus(
        name=name,
        level=level,
        message=text,
        hardware_id=hardware or socket.gethostname(),
        values=shown,
    )
