"""Quality of service of every topic, and what parameters may make of it; reasons in msg_docs/."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

_NONE = Duration()  # no deadline
_DEADLINE = 10  # periods without a message that are offered never to pass
_SHORTEST = 2  # periods, of a deadline that a parameter gives

# The newest value, said again to whoever comes late.
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
# Poses in and clouds out: the newest counts, nothing is sent twice.
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
# Wrenches: the newest counts, and subscribers of either kind are served.
COMMAND = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


def state(n_tools: int) -> QoSProfile:
    """One message a tool a step on the same topic."""
    return QoSProfile(depth=2 * n_tools, reliability=ReliabilityPolicy.RELIABLE)


STATISTICS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


@dataclass(frozen=True)
class Quality:
    """A profile, and what parameters may make of it: history and durability never change.

    period : of the messages [s], which bounds a deadline; infinity: none can be given
    depths : fewest and most
    has_deadline : one of ten periods is offered
    """

    profile: QoSProfile
    period: float = math.inf
    depths: tuple[int, int] = (1, 1)
    has_deadline: bool = False

    def fresh(self) -> QoSProfile:
        """The profile, for rclpy to write overrides into."""
        own = self.profile
        nanoseconds = round(_DEADLINE * self.period * 1e9) if self.has_deadline else 0
        return QoSProfile(
            depth=own.depth,
            reliability=own.reliability,
            durability=own.durability,
            deadline=Duration(nanoseconds=nanoseconds),
        )

    def refusal(self, given: QoSProfile) -> str:
        """The policy that may not be so, why, and what it takes; empty if all is well."""
        own, (fewest, most) = self.profile, self.depths
        latched = own.durability == DurabilityPolicy.TRANSIENT_LOCAL
        kinds = (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT)[: 1 if latched else 2]
        if given.reliability not in kinds:
            why = "who needs this file needs all of it; " if latched else ""
            return f"reliability: {why}give {' or '.join(kind.name.lower() for kind in kinds)}"
        if given.durability != own.durability:
            late = "needs the newest" if latched else "must not get an old one"
            return f"durability: who comes late {late}; give {own.durability.name.lower()}"
        if not fewest <= given.depth <= most:
            numbers = (
                f"{fewest} to {most}" if most > fewest else f"{fewest}, as only the newest counts"
            )
            return f"depth: give {numbers}"
        if given.deadline == _NONE:
            return ""
        if math.isinf(self.period):
            return "deadline: messages come on demand; give 0, for none"
        shortest = round(_SHORTEST * self.period * 1e9)
        if given.deadline.nanoseconds < shortest:
            return f"deadline: give at least {shortest} ns, {_SHORTEST} periods, or 0 for none"
        return ""


ONCE = Quality(LATCHED)


def poses(period: float) -> Quality:
    """One is taken a step: a queue would only make them late. No deadline is asked for, which
    would shut out every driver that offers none."""
    return Quality(NEWEST, period)


def wrenches(period: float) -> Quality:
    """A driver that asks for a deadline learns that the stream is lost. It costs the loop 30 us a
    step, so that it is offered nowhere else."""
    return Quality(COMMAND, period, has_deadline=True)


def states(n_tools: int, period: float) -> Quality:
    return Quality(state(n_tools), period, (n_tools, 1000))


def clouds(period: float) -> Quality:
    """No deadline is offered: how often they come changes while they do."""
    return Quality(NEWEST, period, (1, 10))


def reports(period: float) -> Quality:
    return Quality(STATISTICS, period, (1, 1000))
