"""The device of a tool, as its driver describes it by ``operating_state`` and ``state_command``.

A device is ready, in CRTK's terms, when it is enabled and homed. Drivers publish the state when it
changes and keep the last message for late listeners. So an old message is still valid, but a
missing publisher is not. The node alone uses this file; the loop reads ``ToolChannel.device``.

A colcon workspace may lack crtk_msgs, which rosdep does not know. Only devices need it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from builtin_interfaces.msg import Time
from rclpy.node import Node

from avatar_core.contact.status import Status
from avatar_ros.framework import qos
from avatar_ros.framework.parameters import ParameterError
from avatar_ros.loop.settings import LoopSettings
from avatar_ros.loop.tool_channel import OK, ToolChannel

if TYPE_CHECKING:
    from crtk_msgs.msg import OperatingState

NOTHING_SAID = int(Status.NO_OPERATING_STATE)
NOT_ENABLED = int(Status.NOT_ENABLED)
NOT_HOMED = int(Status.NOT_HOMED)
OF_DEVICE = (NOTHING_SAID, NOT_ENABLED, NOT_HOMED)

_STATES = ("DISABLED", "ENABLED", "PAUSED", "FAULT")


class ToolDevice:
    """Hears one device, tells its tool's channel, and sends the commands that parameters ask for.

    After ``begin`` each command is sent at most once: ``enable`` to a disabled device, ``home`` to
    one that is enabled, idle and not homed. A device that was ready once gets no further command. A
    device that is paused or in fault gets none either, because a person decided that.

    Attributes
    ----------
    subscription, publisher : optional
        Ends of the two topics, made by :func:`devices`; no publisher without commands.
    """

    def __init__(
        self, tool: ToolChannel, commands: tuple[str, ...], now: Callable[[], Time]
    ) -> None:
        self.subscription: Any = None
        self.publisher: Any = None
        self._tool = tool
        self._commands, self._now = commands, now
        self._to_send: tuple[str, ...] = ()
        self._wanted = ""  # the command that the device needs
        tool.device = NOTHING_SAID

    def begin(self) -> None:
        """Send commands from now on."""
        self._to_send = self._commands

    def hear(self, message: OperatingState) -> None:
        """Note the state that the device published."""
        state = message.state if message.state in _STATES else "an unknown state"
        self._tool.operating_state = f"{state}, {'' if message.is_homed else 'not '}homed"
        self._wanted = ""
        if state != "ENABLED":
            self._tell(NOT_ENABLED)
            self._wanted = "enable" if state == "DISABLED" else ""
        elif not message.is_homed:
            self._tell(NOT_HOMED)
            self._wanted = "" if message.is_busy else "home"
        else:
            self._tell(OK)
            self._to_send = ()

    def attend(self) -> str:
        """Forget a device that is gone; return the command that was sent, or an empty text."""
        if self.subscription.get_publisher_count() == 0:
            self._tool.operating_state = self._wanted = ""
            self._tell(NOTHING_SAID)
        command = self._wanted
        if command not in self._to_send or self.publisher.get_subscription_count() == 0:
            return ""
        self._to_send = tuple(each for each in self._to_send if each != command)
        message = _crtk().StringStamped(string=command)
        message.header.stamp = self._now()
        self.publisher.publish(message)
        return command

    def _tell(self, status: int) -> None:
        if status not in (OK, self._tool.device):
            self._tool.faults[status] += 1
        self._tool.device = status


def devices(node: Node, settings: LoopSettings, tools: Sequence[ToolChannel]) -> list[ToolDevice]:
    """Make the devices of all tools that have one, if ``tool_operating_state`` asks for them.

    Raises
    ------
    ParameterError
        If ``tool_operating_state`` asks for them and crtk_msgs is not installed.
    """
    made = []
    for name, tool in zip(settings.tools, tools, strict=True):
        safety = settings.safety_of(name)
        if not safety.hears_state:
            continue
        device = ToolDevice(tool, safety.commands, lambda: node.get_clock().now().to_msg())
        device.subscription = node.create_subscription(
            _crtk().OperatingState, f"{name}/operating_state", device.hear, qos.LATCHED
        )
        if safety.commands:
            device.publisher = node.create_publisher(
                _crtk().StringStamped, f"{name}/state_command", qos.COMMAND
            )
        made.append(device)
    return made


def _crtk() -> Any:
    """Return the messages of crtk_msgs."""
    try:
        from crtk_msgs import msg
    except ImportError as error:
        raise ParameterError(
            "parameter tool_operating_state: crtk_msgs is not installed; clone it into the "
            "workspace and build it, or set the parameter to false"
        ) from error
    return msg
