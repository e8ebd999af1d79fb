"""Publishers and subscriptions whose quality of service parameters may change.

The parameters are those of rclpy, ``qos_overrides.TOPIC.publisher.POLICY`` or ``.subscription.``;
:class:`avatar_ros.framework.qos.Quality` says which values are accepted.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import CallbackGroup
from rclpy.duration import Infinite
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.node import Node
from rclpy.qos import (
    LivelinessPolicy,
    QoSCompatibility,
    QoSPolicyKind,
    QoSProfile,
    qos_check_compatible,
    qos_policy_name_from_kind,
)
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.topic_endpoint_info import TopicEndpointInfo

from avatar_ros.framework.parameters import ParameterError
from avatar_ros.framework.qos import Quality

POLICIES = (
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.DEADLINE,
)


ONE_CELL = (  # remedy for several publishers of a topic
    "end all but one (a node that was killed counts for 20 s), or give each cell its own "
    "ROS_DOMAIN_ID or namespace"
)
_MAX_LOGGED = 100  # number of lines; later mismatches are only in the diagnostics


class PolledSubscriptions(CallbackGroup):
    """A callback group that no executor serves: the loop takes the messages itself.

    An executor that waited for events of these subscriptions would wake up with every pose and
    delay the loop.
    """

    def can_execute(self, entity: Any) -> bool:
        """Return false: no callback runs."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Return false: no callback runs."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Do nothing."""
        pass


def publishers(node: Node, topic: str) -> dict[str, str]:
    """Return the full node name of each publisher of a topic, by the publisher's GID."""
    ends = node.get_publishers_info_by_topic(topic)
    return {bytes(end.endpoint_gid).hex(): _full_name(end) for end in ends}


def _full_name(end: TopicEndpointInfo) -> str:
    """Return namespace and name of a publisher's node; the middleware learns them a bit later."""
    if end.node_name == "_NODE_NAME_UNKNOWN_":
        return "a node that just joined"
    return f"{end.node_namespace.rstrip('/')}/{end.node_name}"


def rivals(node: Node, topic: str) -> str:
    """Name the publishers of a topic that should have only one; empty if it has at most one."""
    if node.count_publishers(topic) <= 1:  # counting is faster
        return ""
    names = " and ".join(sorted(publishers(node, topic).values()))
    return f"{topic} is published by {names}"


def _as_discovered(profile: QoSProfile) -> QoSProfile:
    """Return a profile as other nodes see it: durations left to the middleware are infinite."""
    return QoSProfile(
        depth=profile.depth,
        reliability=profile.reliability,
        durability=profile.durability,
        deadline=profile.deadline if profile.deadline.nanoseconds else Infinite,
        liveliness=LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=Infinite,
    )


class Ports:
    """Makes publishers and subscriptions, and reports incompatible ends in other nodes.

    Raises
    ------
    ParameterError
        If an override has a value that is not accepted.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        # topics that have had an incompatible end
        self._suspects: dict[tuple[str, str], QoSProfile] = {}
        self._silent: set[str] = set()  # topics without events: always suspect
        self._logged: set[str] = set()

    def publisher(self, kind: type, topic: str, quality: Quality) -> Any:
        """Make a publisher, with the overrides of its quality of service."""
        profile, name = quality.fresh(), self._node.resolve_topic_name(topic)
        return self._made(
            lambda options: self._node.create_publisher(
                kind,
                topic,
                profile,
                event_callbacks=PublisherEventCallbacks(
                    incompatible_qos=lambda event: self._log("publisher", name, profile, event)
                ),
                qos_overriding_options=options,
            ),
            f"qos_overrides.{name}.publisher",
            profile,
            quality,
        )

    def subscription(
        self,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        quality: Quality,
        silent: bool = False,
        **how: Any,
    ) -> Any:
        """Make a subscription; ``how`` goes to rclpy; ``silent``: no executor takes its events."""
        profile, name = quality.fresh(), self._node.resolve_topic_name(topic)
        events = SubscriptionEventCallbacks(
            incompatible_qos=lambda event: self._log("subscription", name, profile, event)
        )
        if silent:
            events = SubscriptionEventCallbacks(use_default_callbacks=False)
            self._suspects["subscription", name] = profile
            self._silent.add(name)
        return self._made(
            lambda options: self._node.create_subscription(
                kind,
                topic,
                callback,
                profile,
                event_callbacks=events,
                qos_overriding_options=options,
                **how,
            ),
            f"qos_overrides.{name}.subscription",
            profile,
            quality,
        )

    def mismatches(self) -> list[str]:
        """List ends in other nodes that are incompatible with those of this node, one line each.

        Only topics that have had an incompatible end are checked, and silent ones.
        """
        found = []
        for (side, topic), profile in list(self._suspects.items()):
            own = _as_discovered(profile)
            publishes = side == "publisher"
            look = self._node.get_subscriptions_info_by_topic
            if not publishes:
                look = self._node.get_publishers_info_by_topic
            for end in look(topic):
                pair = (own, end.qos_profile) if publishes else (end.qos_profile, own)
                compatible, reason = qos_check_compatible(*pair)
                if compatible == QoSCompatibility.ERROR:
                    cause = " ".join(reason.removeprefix("ERROR: ").split()).rstrip(";")
                    found.append(f"{topic}: not matched with {end.node_name} ({cause})")
                    if topic in self._silent:
                        self._log_once(topic, end.node_name, cause)
        return found

    def _made(
        self,
        make: Callable[[QoSOverridingOptions], Any],
        prefix: str,
        profile: QoSProfile,
        quality: Quality,
    ) -> Any:
        def judge(given: QoSProfile) -> SetParametersResult:
            reason = quality.refusal(given)
            return SetParametersResult(successful=not reason, reason=reason)

        try:
            return make(QoSOverridingOptions(POLICIES, callback=judge))
        except InvalidQosOverridesError as error:
            raise ParameterError(f"parameter {prefix}.{quality.refusal(profile)}") from error
        except (InvalidParameterTypeException, RuntimeError, ValueError) as error:
            text = " ".join(str(error).split())
            raise ParameterError(
                f"parameter {prefix}.*: {text}; give reliability and durability as words, depth "
                "and deadline [ns] as whole numbers"
            ) from error

    def _log_once(self, topic: str, name: str, cause: str) -> None:
        line = (
            f"{topic}: {name} is not heard here ({cause}); change its policy, or "
            f"qos_overrides.{topic}.subscription.* of this node"
        )
        if line not in self._logged and len(self._logged) < _MAX_LOGGED:
            self._logged.add(line)
            self._node.get_logger().warning(line)

    def _log(self, side: str, topic: str, profile: QoSProfile, event: Any) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind).split(".")[-1].lower()
        self._suspects[side, topic] = profile
        what = "gets nothing from here" if side == "publisher" else "is not heard here"
        other = "subscription" if side == "publisher" else "publisher"
        self._node.get_logger().warning(
            f"{topic}: a {other} of other {policy} {what}; change its {policy}, or "
            f"qos_overrides.{topic}.{side}.{policy} of this node"
        )
