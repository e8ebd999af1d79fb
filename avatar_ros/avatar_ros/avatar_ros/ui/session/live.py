"""Live data of the contact node, as the planning page draws them: each cloud with its period."""

from __future__ import annotations

import time

import numpy as np
from rclpy.node import Node

from avatar_ros.framework.templates import stamp_nanoseconds
from avatar_ros.ui.session.recorder import Recorder
from avatar_ros.ui.session.shown_period import OTHER_ORGAN, SILENT, PeriodChooser, ShownPeriod
from avatar_ros.ui.tools.tool_state import SharedToolState
from avatar_ros.ui.view.display import NewestCloud
from avatar_ros.ui.view.view import OrganView

_SILENCE = 1.0  # time after which the contact node counts as not answering [s]


class Live:
    """Takes the clouds, and finds the forces of their periods.

    node : subscribes; state : holds the periods; recorder : keeps the clouds of a recording
    organ : number of the organ that is shown; periods of another organ are not drawn
    """

    def __init__(self, node: Node, state: SharedToolState, recorder: Recorder) -> None:
        self._node, self._state, self._recorder = node, state, recorder
        self._cloud: NewestCloud | None = None
        self._periods = PeriodChooser()
        self._shown: tuple[ShownPeriod, ...] = ()
        self._last_cloud = 0.0  # [s]
        self.organ = 0

    @property
    def is_listening(self) -> bool:
        """Return whether clouds are subscribed."""
        return self._cloud is not None

    def listen(self, frame_id: str, n_points: int) -> None:
        """Take clouds with this number of points in a frame, and no others."""
        self.close()
        self._cloud = NewestCloud(self._node, frame_id, n_points)

    def close(self) -> None:
        """Stop listening."""
        if self._cloud is not None:
            self._cloud.close()
            self._cloud = None

    def forget(self) -> None:
        """Forget the last organ or tools, so that nothing of them is shown."""
        self._periods.forget()
        self.pause()

    def pause(self) -> None:
        """Forget the drawn period while something else is drawn."""
        self._shown = ()

    @property
    def answers(self) -> bool:
        """Return whether the contact node answered recently."""
        silence = time.monotonic_ns() - int(self._state.all["heard"][0])
        return silence < _SILENCE * 1e9

    @property
    def statuses(self) -> tuple[int, ...]:
        """Return the status of each tool in the last period, if one came recently."""
        period = self._state.period() if self.answers else None
        return () if period is None else tuple(period["status"].tolist())

    def draw(self, view: OrganView) -> tuple[ShownPeriod, ...]:
        """Draw the newest cloud, and return each tool's numbers of its period."""
        sent, cloud, now = self._state.sent, self._cloud, time.monotonic()
        taken = cloud.take() if cloud is not None else None
        if not self.answers:
            return self._without_force(view, sent, SILENT)
        if taken is not None:
            self._last_cloud = now
            rows = self._state.period(stamp_nanoseconds(taken[0]))
        elif self._shown and now - self._last_cloud < _SILENCE:
            return self._shown
        else:  # the contact node sends another cloud, or none
            rows = self._state.period()
        if rows is None or int(rows["organ"][0]) != self.organ:
            return self._without_force(view, sent, OTHER_ORGAN)
        largest = float("nan")
        if self._periods.take(rows) and taken is not None:
            largest = view.move(taken[1])
        view.grey(self._periods.is_unknown)
        if taken is not None and self._recorder.is_on:
            self._recorder.note_cloud(taken[1][:, 3:], int(rows["number"][0]))
        self._shown = self._periods.drawn(rows, largest, sent)
        return self._shown

    def _without_force(
        self, view: OrganView, sent: np.ndarray, missing: str
    ) -> tuple[ShownPeriod, ...]:
        """Mark the picture as not present, and return numbers without forces."""
        view.grey(True)
        self._periods.forget()
        self._shown = tuple(ShownPeriod.without_force(tip, missing) for tip in sent)
        return self._shown
