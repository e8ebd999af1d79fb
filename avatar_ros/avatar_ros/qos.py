"""Quality of service of every topic; the reasons stand in msg_docs/."""

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

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
