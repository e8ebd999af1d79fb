"""Reports of a device and commands to it, without any process."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from builtin_interfaces.msg import Time
from crtk_msgs.msg import OperatingState

from avatar_interfaces.msg import ContactState
from avatar_ros.framework.parameters import ParameterError
from avatar_ros.loop.device import ToolDevice, devices
from avatar_ros.loop.diagnostics import FaultCounter
from avatar_ros.loop.safety import COMMANDS, Safety
from avatar_ros.loop.tool_channel import ToolChannel
from tests.ros.helpers.refusals import refusal

NOTHING, NOT_ENABLED, NOT_HOMED = (
    ContactState.STATUS_NO_OPERATING_STATE,
    ContactState.STATUS_NOT_ENABLED,
    ContactState.STATUS_NOT_HOMED,
)


class Driver:
    """The other end of both topics, and a tool whose poses are valid."""

    def __init__(self, asked: str) -> None:
        self.there, self.asked_for = 1, list[str]()
        self.tool = ToolChannel(None, None, "organ")
        self.device = ToolDevice(self.tool, COMMANDS[asked], lambda: Time(sec=1))
        self.device.subscription = self.device.publisher = self
        self.device.begin()

    def get_publisher_count(self) -> int:
        return self.there

    get_subscription_count = get_publisher_count

    def publish(self, message: Any) -> None:
        assert message.header.stamp.sec == 1
        self.asked_for.append(message.string)

    def says(self, state: str, homed: bool = False, busy: bool = False) -> int:
        """Return the status of the device after this report."""
        self.device.hear(OperatingState(state=state, is_homed=homed, is_busy=busy))
        for _ in range(3):
            self.device.attend()
        return self.tool.device


def test_only_a_device_that_is_enabled_and_homed_is_ready() -> None:
    driver = Driver("")
    assert driver.tool.device == NOTHING
    for state in ("DISABLED", "PAUSED", "FAULT", "enabled", "ENABLED ", "", "HOMED\n\x1b[31m"):
        assert driver.says(state, homed=True) == NOT_ENABLED
    assert driver.says("ENABLED") == NOT_HOMED
    assert driver.says("ENABLED", homed=True) == ContactState.STATUS_OK
    assert driver.says("ENABLED", homed=True, busy=True) == ContactState.STATUS_OK
    assert not driver.asked_for


def test_a_driver_that_goes_has_to_say_it_anew() -> None:
    driver = Driver("")
    driver.says("ENABLED", homed=True)
    driver.there = 0
    driver.device.attend()
    assert (driver.tool.device, driver.tool.operating_state) == (NOTHING, "")
    driver.there = 1
    assert driver.says("ENABLED", homed=True) == ContactState.STATUS_OK


@pytest.mark.parametrize(
    ("asked", "expected"), [("", []), ("enable", ["enable"]), ("home", ["enable", "home"])]
)
def test_a_device_is_asked_once_for_what_it_lacks(asked: str, expected: list[str]) -> None:
    driver = Driver(asked)
    driver.there = 0
    driver.device.hear(OperatingState(state="DISABLED"))
    driver.there = 1
    driver.says("DISABLED")
    driver.says("DISABLED", busy=True)
    driver.says("ENABLED", busy=True)
    driver.says("ENABLED")
    driver.says("ENABLED")
    assert driver.asked_for == expected
    driver.says("ENABLED", homed=True)
    driver.says("DISABLED")
    driver.says("ENABLED")
    assert driver.asked_for == expected


def test_what_a_person_or_a_fault_stopped_is_not_undone() -> None:
    driver = Driver("home")
    for state in ("PAUSED", "FAULT", "anything"):
        driver.says(state)
    driver.says("ENABLED", homed=True)
    driver.says("DISABLED")
    assert not driver.asked_for
    driver.device.begin()  # activated again
    driver.says("DISABLED")
    assert driver.asked_for == ["enable"]


def test_the_log_says_what_the_device_said_and_what_to_do() -> None:
    driver = Driver("")
    driver.tool.status = ContactState.STATUS_OK
    counter = FaultCounter([driver.tool])
    driver.says("PAUSED", homed=True)
    (faults,) = counter.window()
    assert faults.text == (
        "no force: the tool's device is not enabled; enable it, or resume it if it was paused, at "
        "its console or by NAME/state_command (it says PAUSED, homed)"
    )
    driver.says("ENABLED\n" * 1000, homed=True)
    (faults,) = counter.window()
    assert faults.text.endswith("(it says an unknown state, homed)")
    driver.says("ENABLED", homed=True)
    counter.window()
    assert counter.window()[0].text == ""


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        (["tool_state_command:=home"], "set tool_operating_state to true"),
        (["tool_operating_state:=true", "tool_state_command:=unhome"], "give enable, home or"),
    ],
)
def test_a_command_without_a_state_or_a_meaning_is_refused(values: list[str], reason: str) -> None:
    said = refusal("contact", *values)
    assert said.startswith("parameter tool_state_command: ") and reason in said
    assert "\n" not in said


def test_a_workspace_without_crtk_msgs_refuses_devices(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "crtk_msgs", None)
    settings: Any = SimpleNamespace(
        tools=("left",), safety_of=lambda name: Safety(hears_state=True)
    )
    with pytest.raises(ParameterError, match=r"^parameter tool_operating_state: .* clone it"):
        devices(Mock(), settings, [ToolChannel(None, None, "organ")])
