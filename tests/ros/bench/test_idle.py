"""Idle nodes rest, and react at once to work."""

from __future__ import annotations

from typing import Any

import pytest
from geometry_msgs.msg import WrenchStamped

from avatar_interfaces.msg import ContactState
from avatar_ros.bench.idle import ALL, run_idle
from avatar_ros.framework import qos
from tests.ros.helpers.running import running

pytestmark = pytest.mark.long

# Wake-ups per second. A busy machine makes fewer, never more; times would say nothing there.
MOST_LOOP = 15.0  # ten steps
MOST_MAIN = 5.0  # one report
MOST_OF_OTHERS = 30.0  # the middleware's own, about eight


def test_idle_nodes_wake_up_for_little(own_domain: dict[str, str]) -> None:
    report = run_idle(5.0)
    print("\n" + report.table())
    found = {(row.process, row.thread): row.wake_ups for row in report.threads}
    assert found["contact", "contact loop"] < MOST_LOOP
    assert found.get(("contact", "main"), 0.0) < MOST_MAIN
    assert found["contact", ALL] < MOST_LOOP + MOST_MAIN + MOST_OF_OTHERS
    for name in ("contact's helper 1", "vademecum_loader", "patient_interpolation"):
        assert found[name, ALL] < MOST_OF_OTHERS


def test_who_only_listens_gets_its_zeros(own_domain: dict[str, str], probe: Any) -> None:
    with running("contact", own_domain):
        probe.next(ContactState, "contact_state", qos.state(1))
        probe.spin(1.0)  # so that the node counts seldom
        wrenches: list[Any] = []
        probe.node.create_subscription(WrenchStamped, "tool/servo_cf", wrenches.append, qos.COMMAND)
        probe.until(lambda: len(wrenches) > 20, 30.0)
    assert not any(w.wrench.force.x or w.wrench.force.y or w.wrench.force.z for w in wrenches)
