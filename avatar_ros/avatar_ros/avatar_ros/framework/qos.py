"""Quality of service of every topic, and how parameters may change it; reasons in msg_docs/."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

_NONE = Duration()  # no deadline
_DEADLINE = 10  # deadline that publishers offer [periods]
_MIN_DEADLINE = 2  # shortest deadline that a parameter may set [periods]

# The newest value, sent again to late joiners.
LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
# Poses in and clouds out: only the newest counts, nothing is sent again.
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
# Wrenches: only the newest counts, and subscribers of either reliability are served.
COMMAND = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)


def state(n_tools: int) -> QoSProfile:
    """Return the profile for one message per tool and step on the same topic."""
    return QoSProfile(depth=2 * n_tools, reliability=ReliabilityPolicy.RELIABLE)


STATISTICS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


@dataclass(frozen=True)
class Quality:
    """A profile and the limits of its overrides; history and durability cannot be overridden.

    Attributes
    ----------
    period : float
        Period of the messages [s], a lower bound of deadlines; infinity: no deadline.
    depths : tuple of int
        Smallest and largest depth.
    has_deadline : bool
        Whether a deadline of ten periods is offered by default.
    """

    profile: QoSProfile
    period: float = math.inf
    depths: tuple[int, int] = (1, 1)
    has_deadline: bool = False

    def fresh(self) -> QoSProfile:
        """Return a copy of the profile, for rclpy to write overrides into."""
        own = self.profile
        nanoseconds = round(_DEADLINE * self.period * 1e9) if self.has_deadline else 0
        return QoSProfile(
            depth=own.depth,
            reliability=own.reliability,
            durability=own.durability,
            deadline=Duration(nanoseconds=nanoseconds),
        )

    def refusal(self, given: QoSProfile) -> str:
        """Name the first refused policy, with the reason and accepted values; empty if all pass."""
        own, (fewest, most) = self.profile, self.depths
        latched = own.durability == DurabilityPolicy.TRANSIENT_LOCAL
        kinds = (ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT)[: 1 if latched else 2]
        if given.reliability not in kinds:
            why = "a subscriber needs all of it; " if latched else ""
            return f"reliability: {why}give {' or '.join(kind.name.lower() for kind in kinds)}"
        if given.durability != own.durability:
            late = "needs the newest" if latched else "must not get an old one"
            return f"durability: a late joiner {late}; give {own.durability.name.lower()}"
        if not fewest <= given.depth <= most:
            numbers = (
                f"{fewest} to {most}" if most > fewest else f"{fewest}, as only the newest counts"
            )
            return f"depth: give {numbers}"
        if given.deadline == _NONE:
            return ""
        if math.isinf(self.period):
            return "deadline: messages come on demand; give 0, for none"
        shortest = round(_MIN_DEADLINE * self.period * 1e9)
        if given.deadline.nanoseconds < shortest:
            return f"deadline: give at least {shortest} ns, {_MIN_DEADLINE} periods, or 0 for none"
        return ""


ONCE = Quality(LATCHED)


def poses(period: float) -> Quality:
    """Return the quality of poses: depth one, without a deadline.

    Each step takes one pose: a queue would only make poses late. A requested deadline would exclude
    every driver that offers none.
    """
    return Quality(NEWEST, period)


def wrenches(period: float) -> Quality:
    """Return the quality of wrenches, with a deadline.

    The deadline tells a driver that the stream has stopped. It costs the loop 30 us per step, so no
    other topic offers one.
    """
    return Quality(COMMAND, period, has_deadline=True)


def bands(period: float) -> Quality:
    """Return the quality of band edges: as wrenches, but no deadline is offered."""
    return Quality(COMMAND, period)


def states(n_tools: int, period: float) -> Quality:
    """Return the quality of states."""
    return Quality(state(n_tools), period, (n_tools, 1000))


def clouds(period: float) -> Quality:
    """Return the quality of clouds: no deadline, because the rate may change at run time."""
    return Quality(NEWEST, period, (1, 10))


def reports(period: float) -> Quality:
    """Return the quality of statistics and other reports."""
    return Quality(STATISTICS, period, (1, 1000))
