"""The organ for RViz and Foxglove: its surface at rest and, at display rate, deformed."""

from __future__ import annotations

from typing import Any

import numpy as np
from shape_msgs.msg import Mesh
from visualization_msgs.msg import Marker

from avatar_interfaces.msg import VademecumInfo
from avatar_ros.framework import qos
from avatar_ros.framework.announced import Announced
from avatar_ros.framework.conversions import mesh_arrays
from avatar_ros.framework.managed_node import ManagedNode, run
from avatar_ros.framework.parameters import AUTOSTART, Parameter
from avatar_ros.framework.templates import NO_STAMP
from avatar_ros.ui.view.colours import colours
from avatar_ros.ui.view.display import NewestCloud, TriangleTemplate

_REST_SHADE = (0.6, 0.6, 0.6, 0.25)  # grey, transparent

ORGAN_MARKERS = (
    AUTOSTART,
    Parameter("rate", 30.0, "largest rate of organ_deformed [Hz]", range=(0.1, 100.0)),
    Parameter(
        "full_scale",
        0.01,
        "displacement at the end of the colour scale [m]",
        range=(1e-4, 1.0),
        read_only=False,
    ),
)


class MarkersNode(ManagedNode):
    """Subscribes the topics of loader and contact node; publishes two markers."""

    def __init__(self) -> None:
        self._announced: list[Announced] = []
        self._own_publishers: list[Any] = []
        self._frame = ""
        self._surface: Mesh | None = None
        self._faces = np.zeros(0, np.int64)
        self._template: TriangleTemplate | None = None
        self._cloud: NewestCloud | None = None
        self._timer: Any = None
        super().__init__("organ_markers", ORGAN_MARKERS)

    def configure(self) -> None:
        """Make the publishers and subscribe the announcements."""
        self._own_publishers = [
            self.create_publisher(Marker, "organ_rest", qos.LATCHED),
            self.create_publisher(Marker, "organ_deformed", qos.COMMAND),
        ]
        self._announced = [
            Announced(self, VademecumInfo, "vademecum_info", self._take_frame),
            Announced(self, Mesh, "rest_surface", self._take_surface),
        ]

    def activate(self) -> None:
        """Start to publish at the display rate."""
        rate = self.get_parameter("rate").value
        self._timer = self.create_timer(1.0 / rate, self._show)

    def deactivate(self) -> None:
        """Stop publishing."""
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None

    def clean_up(self) -> None:
        """Remove all topics."""
        for announced in self._announced:
            announced.close()
        for publisher in self._own_publishers:
            self.destroy_publisher(publisher)
        self._announced, self._own_publishers = [], []
        self._forget()

    def _forget(self) -> None:
        if self._cloud is not None:
            self._cloud.close()
        self._cloud = self._template = None

    def _take_frame(self, info: VademecumInfo) -> None:
        self._frame = info.header.frame_id
        self._lay_out()

    def _take_surface(self, surface: Mesh) -> None:
        self._surface = surface
        self._lay_out()

    def _lay_out(self) -> None:
        """Lay out the markers once surface and frame have arrived, in either order."""
        if not self._frame or self._surface is None:
            return
        self._forget()
        vertices, faces = mesh_arrays(self._surface)
        self._faces = faces.reshape(-1)
        rest = TriangleTemplate(self._frame, "organ at rest", len(faces))
        rest.corners[:] = vertices[self._faces]
        rest.colours[:] = _REST_SHADE
        self._own_publishers[0].publish(rest.serialise(NO_STAMP))
        self._template = TriangleTemplate(self._frame, "organ", len(faces))
        self._template.colours[:, 3] = 1.0
        self._cloud = NewestCloud(self, self._frame, len(vertices))

    def _show(self) -> None:
        template, publisher = self._template, self._own_publishers[1]
        if template is None or self._cloud is None:
            return
        taken = self._cloud.take()
        if taken is None or publisher.get_subscription_count() == 0:
            return
        stamp, points = taken
        top = self.get_parameter("full_scale").value
        template.corners[:] = points[self._faces, :3]
        template.colours[:, :3] = colours(points[:, 3:], top)[self._faces]
        publisher.publish(template.serialise(stamp))


def main() -> int:
    """Run the node; return the exit code."""
    return run(MarkersNode)


if __name__ == "__main__":
    raise SystemExit(main())
