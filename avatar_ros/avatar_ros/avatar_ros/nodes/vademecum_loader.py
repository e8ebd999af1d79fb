"""The loader: verifies a vademecum file and publishes its complete content."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from shape_msgs.msg import Mesh
from std_msgs.msg import Header

from avatar_core.common.confined import Imported
from avatar_core.common.processes import return_memory
from avatar_core.errors import AvatarError, StorageError, one_line
from avatar_interfaces.msg import VademecumFile, VademecumInfo
from avatar_interfaces.srv import CalibrateMaterial, LoadVademecum
from avatar_ros.framework import conversions, qos
from avatar_ros.framework.beside import Beside
from avatar_ros.framework.library import read_in_library
from avatar_ros.framework.managed_node import ManagedNode, run
from avatar_ros.framework.parameters import (
    AUTOSTART,
    FRAME_ID,
    Parameter,
    ParameterError,
    frame,
    values,
)
from avatar_ros.framework.reader import Reader
from avatar_ros.framework.saved_state import STATE_DIR, SavedState
from avatar_ros.nodes.calibration import Calibrator

SUMMARY = Imported("avatar_ros.framework.summary", "summary")

VADEMECUM_LOADER = (
    AUTOSTART,
    FRAME_ID,
    Parameter("library_dir", ".", "directory of the vademecums; nothing outside it is read"),
    Parameter("vademecum", "", "file in library_dir to load at start; empty: none"),
    Parameter("max_megabytes", 1024, "largest file that is read [MB]", range=(1, 65536)),
    STATE_DIR,
)


@dataclass(frozen=True)
class LoaderSettings:
    """Parameters of the loader."""

    library_dir: str
    vademecum: str
    frame_id: str
    max_bytes: int


def read_loader(node: Node) -> LoaderSettings:
    """Read the loader's parameters."""
    value = values(node, VADEMECUM_LOADER)
    return LoaderSettings(
        library_dir=os.path.expanduser(value["library_dir"]),
        vademecum=value["vademecum"],
        frame_id=frame(value["frame_id"]),
        max_bytes=value["max_megabytes"] * 1_000_000,
    )


class LoaderNode(ManagedNode):
    """Announces one vademecum at a time; a refused file does not replace the last one."""

    def __init__(self) -> None:
        self._settings: LoaderSettings | None = None
        self._reader: Reader | None = None
        self._calibrator: Calibrator | None = None
        self._loaded = ""
        self._outlets: dict[type, Any] = {}
        self._is_active = False
        super().__init__("vademecum_loader", VADEMECUM_LOADER)
        # exists as long as the node: while inactive it answers, so that no client waits for ever
        self.create_service(LoadVademecum, "load_vademecum", self._answer)
        self._beside = Beside(self, "calibration")
        self.create_service(
            CalibrateMaterial,
            "calibrate_material",
            self._calibrate,
            callback_group=ReentrantCallbackGroup(),
        )
        started = self.get_parameter("vademecum").value
        self._state = SavedState(self, {"vademecum": started})

    def configure(self) -> None:
        """Check the library, start the reader and make the topics."""
        self._settings = read_loader(self)
        if not os.path.isdir(self._settings.library_dir):
            raise ParameterError(
                f"parameter library_dir: {self._settings.library_dir} is not a directory"
            )
        self._reader = Reader(self._settings.max_bytes)
        self._calibrator = Calibrator(self._settings.library_dir, self._settings.max_bytes)
        self._outlets = {
            kind: self.ports.publisher(kind, topic, qos.ONCE)
            for kind, topic in (
                (VademecumInfo, "vademecum_info"),
                (Mesh, "rest_surface"),
                (VademecumFile, "vademecum"),
            )
        }

    def activate(self) -> None:
        """Load the first vademecum, unless one is announced already, and accept requests."""
        assert self._settings is not None
        if not self._loaded:  # the topics keep the announced one while the node is inactive
            self._load_first(self._settings.vademecum)
        return_memory()
        self._is_active = True

    def deactivate(self) -> None:
        """Refuse requests."""
        self._is_active = False

    def clean_up(self) -> None:
        """Stop the processes and remove all topics."""
        if self._reader is not None:
            self._reader.close()
        if self._calibrator is not None:
            self._calibrator.stop()
        self._reader = self._calibrator = None
        for publisher in self._outlets.values():
            self.destroy_publisher(publisher)
        self._outlets, self._loaded = {}, ""

    @property
    def has_pending_answers(self) -> bool:
        """Return whether an answer is still to be sent."""
        return self._beside.n_awaited > 0

    def _load_first(self, name: str) -> None:
        """Load the saved vademecum, or else the parameter's."""
        kept = self._state.load().get("vademecum", name)
        if kept != name:
            try:
                self.load(kept)
                return
            except (AvatarError, OSError) as error:
                self.get_logger().error(f"not loaded again: {error}")
        if name:
            self.load(name)

    def load(self, name: str) -> VademecumInfo:
        """Verify a file of the library and announce it.

        Raises
        ------
        AvatarError
            If the file is refused; nothing was announced.
        """
        assert self._settings is not None and self._reader is not None
        data = read_in_library(name, self._settings.library_dir, self._settings.max_bytes)
        found, vertices, faces = self._reader.read(name, len(data), SUMMARY, data, name)
        header = Header(frame_id=self._settings.frame_id, stamp=self.get_clock().now().to_msg())
        info = conversions.vademecum_info(found, header)
        surface = conversions.surface_mesh(vertices, faces)
        self._loaded = name
        self._outlets[VademecumInfo].publish(info)
        self._outlets[Mesh].publish(surface)
        self._outlets[VademecumFile].publish(conversions.vademecum_file(info.id, info.name, data))
        self.get_logger().info(
            f"announced {info.name!r} ({info.id[:12]}), {len(data) / 1e6:.1f} MB"
        )
        return info

    def _answer(
        self, request: LoadVademecum.Request, response: LoadVademecum.Response
    ) -> LoadVademecum.Response:
        begin = time.monotonic()
        try:
            if not self._is_active:
                raise StorageError("the node is inactive; activate it first")
            response.info = self.load(request.name)
            self._state.save({"vademecum": request.name})
            response.message = f"announced after {time.monotonic() - begin:.2f} s"
            response.success = True
        # a service always answers; the file decides which error is raised
        except Exception as error:
            response.message = one_line(error)
            self.get_logger().error(f"load_vademecum: {response.message}")
        return_memory()
        return response

    async def _calibrate(
        self, request: CalibrateMaterial.Request, response: CalibrateMaterial.Response
    ) -> CalibrateMaterial.Response:
        try:
            calibrator = self._calibrator
            if not self._is_active or calibrator is None:
                raise StorageError("the node is inactive; activate it first")
            loaded = self._loaded
            return await self._beside.done(lambda: calibrator.answered(request, loaded, response))
        except Exception as error:  # as above
            response.message = one_line(error)
            self.get_logger().error(f"calibrate_material: {response.message}")
        return response


def main() -> int:
    """Run the loader; return the exit code."""
    return run(LoaderNode)


if __name__ == "__main__":
    raise SystemExit(main())
