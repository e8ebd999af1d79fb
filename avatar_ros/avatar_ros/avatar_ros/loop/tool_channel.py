"""The channel between the contact loop and one tool: checked poses in, wrenches out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped

from avatar_core.contact.orientation import composed
from avatar_core.contact.status import FAR_AWAY, Status
from avatar_ros.framework import qos
from avatar_ros.framework.ports import PolledSubscriptions, Ports
from avatar_ros.framework.templates import NO_STAMP, PoseReader, WrenchTemplate, rotated
from avatar_ros.loop.jaw import JawChannel, jaw_channel
from avatar_ros.loop.safety import WRENCHES, Safety, band_topics
from avatar_ros.loop.settings import LoopSettings

OK = int(Status.OK)
NO_POSE = int(Status.NO_POSE)
STALE_POSE = int(Status.STALE_POSE)
INVALID_POSE = int(Status.INVALID_POSE)
LEAP = int(Status.LEAP)
SEVERAL_PUBLISHERS = int(Status.SEVERAL_PUBLISHERS)
LOST_TOOL = int(Status.LOST_TOOL)
SLOW_POSES = int(Status.SLOW_POSES)
UNKNOWN_FRAME = int(Status.UNKNOWN_FRAME)

_UNKNOWN = float("nan")  # position of a tool whose last pose was invalid: it may not have moved
_LEAP_INTERVAL = 2e-3  # time between two poses, to which ``leap`` refers [s]
_SLOW = 0.75  # fraction of the timeout: poses farther apart are slow
# a refused stream stays refused until the next message, or until none came for this long [ns]
_SILENCE = 2_500_000_000
_ENDED = (STALE_POSE, LOST_TOOL)  # statuses after which the next pose starts another stream
_OF_A_STREAM = (INVALID_POSE, UNKNOWN_FRAME, SEVERAL_PUBLISHERS, SLOW_POSES)
_NO_INTERVALS = (0, 0, 0)  # [ns]
_NO_NUMBER = 2**64 - 1  # sequence number of middleware that does not count messages
_N_STATUS = 32


class ToolChannel:
    """One tool's subscription, publishers and last pose.

    Poses come in the tool's frame; ``tip`` and ``orientation`` of the step are in the organ's. The
    node sets ``senders``, ``listeners``, ``band_listeners``, ``device`` and ``operating_state``;
    the
    loop sets ``solved``.

    Attributes
    ----------
    band_publishers : tuple
        Publishers of the low and the high edge of its force's band; may be empty.
    jaw : JawChannel, optional
        Channel of its jaw; None if the tool has none.
    status : int
        OK with a usable pose, otherwise the reason why there is none.
    stamp : bytes
        Stamp of the last valid pose, eight bytes; zero before the first.
    publishers : int
        Publishers of its poses at the last count; a killed one counts for a while.
    senders : dict
        Node name of each publisher of its poses, by GID.
    listeners, band_listeners : int
        Subscribers to its wrenches and to their bands.
    device : int
        OK if its device takes forces or is not heard, otherwise the reason why not.
    operating_state : str
        Last state that its device reported, in words; empty before.
    solved : int
        Status of the last step for it.
    faults : ndarray of int
        How often each status was entered since the node started, by its number.
    """

    def __init__(
        self,
        subscription: Any,
        publisher: Any,
        frame_id: str,
        safety: Safety | None = None,
        band: tuple[Any, ...] = (),
        jaw: JawChannel | None = None,
    ) -> None:
        safety = safety or Safety()
        frame = safety.frame or frame_id
        self.subscription = subscription
        self.publisher = publisher
        self.wrench = WrenchTemplate(frame)
        self.status = NO_POSE
        self.stamp = NO_STAMP
        self.publishers = 0
        self.senders: dict[str, str] = {}
        self.listeners = 0
        self.band_listeners = 0
        self.band_publishers = band
        self.jaw = jaw
        self.device = OK
        self.operating_state = ""
        self.solved = OK
        self.faults = np.zeros(_N_STATUS, np.int64)
        self._edges = [WrenchTemplate(frame) for _ in band]
        self._reader = PoseReader(frame)
        i, j, k, w = np.array(safety.transform[3:]) / math.hypot(*safety.transform[3:])
        # orientation of the tool's frame in the organ's
        self._frame = (float(i), float(j), float(k), float(w))
        self._rotation = _rotation(self._frame)
        self._is_turned = not np.array_equal(self._rotation, np.eye(3))
        self._origin = np.array(safety.transform[:3])
        self._turned = np.zeros(3)
        self._last = np.full(3, FAR_AWAY)  # last valid position, in the tool's frame [m]
        self._received = 0  # time of the last valid pose [ns]
        self._heard = 0  # time of the last message, valid or not [ns]
        self._intervals = _NO_INTERVALS  # between the last valid poses of this stream [ns]
        self._number = -1  # sequence number of the last message
        self._renewed = (
            self._mixed
        ) = -1  # times when numbers last decreased: after the end of a stream, and within one [ns]
        self._counted = 0  # time when the node last counted publishers [ns]
        self._sender = ""  # GID of the last publisher that was heard alone
        self._replaced: set[str] = set()  # publishers whose stream had ended when another began
        self._several = False  # whether there are several publishers, replaced ones apart
        self._kind = safety.wrench
        # position and orientation of the last pose that was used, kept while the channel exists
        self._reference = np.zeros(3)
        self._axes = (0.0, 0.0, 0.0, 1.0)

    @property
    def ports(self) -> tuple[Any, ...]:
        """Return its subscription and publishers."""
        jaw = () if self.jaw is None else (self.jaw.subscription,)
        return (self.subscription, self.publisher, *self.band_publishers, *jaw)

    @property
    def connected(self) -> bool:
        """Return whether somebody sends its poses or takes its wrenches. Real-time safe."""
        return self.publishers > 0 or self.listeners > 0

    @property
    def fault(self) -> int:
        """Return why poses or device allow no force; OK if they do. Real-time safe."""
        return self.status if self.status != OK else self.device

    def take(
        self,
        now: int,
        timeout: int,
        tip: np.ndarray,
        orientation: np.ndarray,
        leap: float = math.inf,
    ) -> bool:
        """Take the newest pose, if any; return true if a usable one came. Real-time safe.

        A tool whose device allows no force is far away.

        Parameters
        ----------
        now, timeout : int
            Present time and time limit of a pose [ns].
        tip : ndarray, shape (3,)
            Receives the position [m].
        orientation : ndarray, shape (4,)
            Receives the tool's quaternion x y z w; zero without a usable pose.
        leap : float
            Distance in 2 ms that is a fault, proportionally more in a longer interval [m].
        """
        taken = self.subscription.handle.take_message(PoseStamped, True)
        status = self._judge(taken, now, timeout, leap)
        if status != self.status:
            self.faults[status] += 1
            self.status = status
        if status != OK:
            orientation[:] = 0.0
            held = status == INVALID_POSE and now - self._received <= timeout
            tip[:] = _UNKNOWN if held else FAR_AWAY
            return False
        if self.device != OK:  # a hand moves it without resistance: it touches nothing
            orientation[:] = 0.0
            tip[:] = FAR_AWAY
            return taken is not None
        if taken is None:
            return False
        self._place(tip, orientation)
        return True

    def note_solved(self, status: int) -> None:
        """Note the status that the model's step returned for this tool. Real-time safe."""
        if status != self.solved:
            self.faults[status] += 1
            self.solved = status

    def note_senders(self, senders: dict[str, str], now: int) -> None:
        """Note who sends poses; called by the node, outside the loop.

        The middleware lists a killed driver for another 20 s. A driver does not count if its stream
        had
        ended when the next one began, unless it sends again.

        Parameters
        ----------
        senders : dict
            As the attribute.
        now : int
            Time before the middleware was asked for them [ns].
        """
        if self._mixed >= self._counted:
            self._replaced = set()
        elif self._renewed >= self._counted and len(senders.keys() - self._replaced) == 2:
            self._replaced.add(self._sender)
        self._replaced &= senders.keys()
        alive = senders.keys() - self._replaced
        if len(alive) == 1 and self._heard >= self._counted:
            (self._sender,) = alive
        self._several = len(alive) > 1
        self.senders, self.publishers, self._counted = senders, len(senders), now

    def answer(self) -> None:
        """Send ``wrench``, given in the organ's frame, in the tool's form. Real-time safe."""
        self._send(self.publisher, self.wrench)

    def send_band(self, edges: np.ndarray) -> None:
        """Send both edges of its band, if anybody listens. Real-time safe.

        edges : force and torque, shape (2, 6), in the organ's frame
        """
        if self.band_listeners == 0:
            return
        for publisher, wrench, edge in zip(self.band_publishers, self._edges, edges, strict=False):
            wrench.force[:], wrench.torque[:] = edge[:3], edge[3:]
            self._send(publisher, wrench)

    def _send(self, publisher: Any, wrench: WrenchTemplate) -> None:
        """Send a wrench, given in the organ's frame, in the tool's form. Real-time safe."""
        force, torque = wrench.force, wrench.torque
        if self._is_turned:
            for part in (force, torque):
                np.dot(part, self._rotation, out=self._turned)  # R^T v
                part[:] = self._turned
        if self._kind == "body":
            i, j, k, w = self._axes
            for part in (force, torque):
                part[:] = rotated((part[0], part[1], part[2]), (-i, -j, -k, w))
        elif self._kind == "spatial" and self.stamp != NO_STAMP:
            x, y, z = self._reference
            torque[0] += y * force[2] - z * force[1]
            torque[1] += z * force[0] - x * force[2]
            torque[2] += x * force[1] - y * force[0]
        publisher.handle.publish_raw(wrench.serialise(self.stamp))

    def _judge(self, taken: Any, now: int, timeout: int, leap: float) -> int:
        """Return the status after a message, or after none came. Real-time safe."""
        if taken is None:
            return self._in_silence(now, timeout)
        self._heard = now
        self.publishers = max(self.publishers, 1)  # counted again only once in a while
        status = self._reader.read(taken[0])
        if self._comes_from_several(taken[1], now):
            status = SEVERAL_PUBLISHERS
        if status != OK:
            return status
        interval = max((now - self._received) * 1e-9, _LEAP_INTERVAL)
        leapt = math.dist(self._reader.position, self._last) * _LEAP_INTERVAL > leap * interval
        late = now - self._received > timeout
        self._intervals = (*self._intervals[1:], now - self._received)
        self._last[:] = self._reader.position
        self._received = now
        self.stamp = self._reader.stamp
        # median: a property of the stream, not of one pose
        if sorted(self._intervals)[1] > _SLOW * timeout:
            return SLOW_POSES
        if late:  # after a good pose, only if the loop itself was held up
            return STALE_POSE if self.status == OK else OK
        return LEAP if leapt and self.status in (OK, LEAP, INVALID_POSE) else OK

    def _in_silence(self, now: int, timeout: int) -> int:
        """Return the status of a period without a message. Real-time safe."""
        if self.status == NO_POSE or now - self._received <= timeout:
            return self.status
        if not self.publishers or now - self._heard > _SILENCE:
            self._intervals = _NO_INTERVALS  # the next message begins another stream
            return STALE_POSE if self.publishers else LOST_TOOL
        if self.status in _OF_A_STREAM:
            return self.status
        # silence both before and after the last pose: a slow stream, as far as is known
        return SLOW_POSES if self._intervals[-1] > timeout else STALE_POSE

    def _comes_from_several(self, info: Any, now: int) -> bool:
        """Return whether poses come from several publishers. Real-time safe.

        The node counts them; sequence numbers that do not increase show it before the next count.
        """
        number = info["publication_sequence_number"] if info else None
        if number is not None and number != _NO_NUMBER:
            if number <= self._number and self.status in _ENDED:
                self._renewed = now
            elif number <= self._number:
                self._mixed = now
            self._number = number
        counted = self._several and self._renewed < self._counted
        return counted or self._mixed >= self._counted

    def _place(self, tip: np.ndarray, orientation: np.ndarray) -> None:
        """Transform the last pose into the organ's frame. Real-time safe."""
        tip[:] = self._reference[:] = self._last
        self._axes = self._reader.orientation
        orientation[:] = self._axes
        if self._is_turned:
            np.dot(self._rotation, tip, out=self._turned)
            tip[:] = self._turned
            orientation[:] = composed(self._frame, self._axes)
        tip += self._origin


def tool_channels(ports: Ports, settings: LoopSettings) -> list[ToolChannel]:
    """Make the channels of all tools; the loop takes their messages itself.

    Raises
    ------
    ParameterError
        If an override of the quality of service has a refused value.
    """
    polled = PolledSubscriptions()
    return [_channel(ports, settings, name, polled) for name in settings.tools]


def _channel(
    ports: Ports, settings: LoopSettings, name: str, polled: PolledSubscriptions
) -> ToolChannel:
    period, safety = 1.0 / settings.rate, settings.safety_of(name)
    return ToolChannel(
        ports.subscription(
            PoseStamped,
            f"{name}/measured_cp",
            lambda message: None,  # never called
            qos.poses(period),
            silent=True,
            callback_group=polled,
            raw=True,
        ),
        ports.publisher(WrenchStamped, f"{name}/{WRENCHES[safety.wrench]}", qos.wrenches(period)),
        settings.frame_id,
        safety,
        tuple(
            ports.publisher(WrenchStamped, f"{name}/{edge}", qos.bands(period))
            for edge in band_topics(safety.wrench)
        ),
        jaw_channel(ports, name, settings.jaw, period, polled),
    )


def _rotation(quaternion: tuple[float, ...]) -> np.ndarray:
    """Return the rotation matrix of a unit quaternion x, y, z, w."""
    i, j, k, w = quaternion
    return np.array(
        [
            [1 - 2 * (j * j + k * k), 2 * (i * j - k * w), 2 * (i * k + j * w)],
            [2 * (i * j + k * w), 1 - 2 * (i * i + k * k), 2 * (j * k - i * w)],
            [2 * (i * k - j * w), 2 * (j * k + i * w), 1 - 2 * (i * i + j * j)],
        ]
    )
