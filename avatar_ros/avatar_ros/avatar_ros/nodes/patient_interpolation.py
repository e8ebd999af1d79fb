"""Node that makes a new patient's vademecum from an atlas, in the library of the loader."""

from __future__ import annotations

import math
import os
from array import array
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup

from avatar_core.errors import one_line
from avatar_core.geometry.label_files import is_label_map
from avatar_interfaces.action import BuildPatient
from avatar_interfaces.srv import InterpolatePatient
from avatar_ros.framework import conversions
from avatar_ros.framework.beside import Beside
from avatar_ros.framework.library import RefusedError, file_name, find_in_library
from avatar_ros.framework.managed_node import ManagedNode, run
from avatar_ros.framework.parameters import ParameterError
from avatar_ros.patients.builder import PatientBuilder
from avatar_ros.patients.protocol import (
    Built,
    BusyError,
    CancelledError,
    PatientRequest,
    Previewed,
    Stage,
    stem,
)
from avatar_ros.patients.settings import (
    PATIENT_INTERPOLATION,
    InterpolationSettings,
    read_interpolation,
)

_DEFAULT_FIDELITY = "interpolated"


def patient_request(request: Any, settings: InterpolationSettings) -> PatientRequest:
    """Check the request of a service call or a goal; the atlas is not needed for that.

    Raises
    ------
    RefusedError
        If a field is not accepted; names the field and the accepted values.
    """
    mesh = request.mesh
    inline = bool(len(mesh.vertices) or len(mesh.triangles))
    if bool(request.surface) == inline:
        raise RefusedError(
            "give either surface, a file in library_dir, or mesh"
            + (", not both" if inline else "; both are empty")
        )
    if request.neighbors < 0:
        raise RefusedError(f"neighbors is {request.neighbors}; give 1 or more, or 0 for all")
    if not (request.tolerance == 0.0 or 0.0 < request.tolerance < 1.0):
        raise RefusedError(
            f"tolerance is {request.tolerance:g}; give a fraction between 0 and 1, or 0 for the "
            "default"
        )
    first = getattr(request, "interpolated_first", False)
    if first and (request.groups or request.supports):
        raise RefusedError(
            "interpolated_first: an interpolated organ is clamped as the template; ask without it, "
            "or without groups and supports"
        )
    fidelity = request.fidelity or _DEFAULT_FIDELITY
    made_of = "mesh" if inline else stem(Path(request.surface).name) or "surface"
    if request.label:
        made_of += f"-{request.label.replace('/', '_')}"
    if inline and (request.label or request.inside):
        raise RefusedError("label and inside are those of a file that holds a label map")
    if request.inside and not is_label_map(Path(request.surface)):
        raise RefusedError(f"{request.surface} is no label map, so nothing can be named inside")
    groups = ""
    if request.groups:
        groups = str(find_in_library(request.groups, settings.library_dir, settings.max_bytes))
    output = file_name(request.name or f"{made_of}-{fidelity}")
    surface, vertices, faces = "", None, None
    if inline:
        _require_metres(request, settings.max_bytes)
        vertices, faces = conversions.mesh_arrays(mesh)
    else:
        surface = str(find_in_library(request.surface, settings.library_dir, settings.max_bytes))
    return PatientRequest(
        surface=surface,
        vertices=vertices,
        faces=faces,
        unit=request.unit or "mm",
        axes=request.axes or None,
        label=request.label or None,
        inside=tuple(request.inside),
        groups=groups,
        supports=tuple(request.supports),
        preview=getattr(request, "preview", False),
        interpolated_first=first,
        leave_out=tuple(request.leave_out),
        neighbors=request.neighbors,
        fidelity=fidelity,
        tolerance=request.tolerance,
        name=output.removesuffix(".h5"),
        output=str(Path(settings.library_dir).resolve() / output),
    )


def _require_metres(request: Any, max_bytes: int) -> None:
    """Raise RefusedError unless an inline mesh is in metres, in the organ's axes, not too large."""
    if request.unit not in ("", "m") or request.axes not in ("", "RAS"):
        raise RefusedError("unit and axes are those of a file; a mesh is given in m and RAS")
    size = 24 * len(request.mesh.vertices) + 12 * len(request.mesh.triangles)
    if size > max_bytes:
        raise RefusedError(f"mesh: {size / 1e6:.0f} MB; raise max_megabytes to take it")


class PatientInterpolationNode(ManagedNode):
    """Builds one patient at a time, for the service or the action.

    Both exist as long as the node, and refuse requests while it is inactive. A separate thread
    waits for the patient; answers are sent from the executor's thread.
    """

    def __init__(self) -> None:
        self._settings: InterpolationSettings | None = None
        self._builder: PatientBuilder | None = None
        self._active = False
        self._beside = Beside(self, "patient")
        super().__init__("patient_interpolation", PATIENT_INTERPOLATION)
        group = ReentrantCallbackGroup()
        self.create_service(
            InterpolatePatient, "interpolate_patient", self._answer, callback_group=group
        )
        self._action = ActionServer(
            self,
            BuildPatient,
            "build_patient",
            self._pursue,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
            callback_group=group,
        )

    def configure(self) -> None:
        """Check the folders and start the builder."""
        settings = read_interpolation(self)
        if not os.path.isdir(settings.library_dir):
            raise ParameterError(f"parameter library_dir: {settings.library_dir} is no directory")
        if not os.access(settings.library_dir, os.W_OK):
            raise ParameterError(
                f"parameter library_dir: {settings.library_dir} cannot be written to"
            )
        self._settings = settings
        self._builder = PatientBuilder(settings.build, settings.threads)
        self.get_logger().info(f"{settings.build.atlas}: {self._builder.n_anatomies} anatomies")

    def activate(self) -> None:
        """Accept requests."""
        self._active = True

    def deactivate(self) -> None:
        """Refuse requests, and cancel the build that runs."""
        self._active = False
        if self._builder is not None:
            self._builder.cancel()

    def clean_up(self) -> None:
        """Stop the builder."""
        if self._builder is not None:
            self._builder.stop()
            self._builder = None

    @property
    def has_pending_answers(self) -> bool:
        """Return whether an answer is still to be sent."""
        return self._beside.n_awaited > 0

    def build(
        self,
        request: Any,
        on_stage: Callable[[Stage], None] = lambda stage: None,
        cancelled: Callable[[], bool] = lambda: False,
    ) -> Built | Previewed:
        """Build the patient of a request or a goal.

        Raises
        ------
        AvatarError, OSError
            If no file was written.
        """
        if self._settings is None or self._builder is None or not self._active:
            raise RefusedError("the node is inactive; activate it first")
        self._builder.require_idle()  # before a large mesh is converted
        patient = patient_request(request, self._settings)
        built = self._builder.build(patient, on_stage, cancelled)
        if isinstance(built, Previewed):
            return built
        self.get_logger().info(
            f"wrote {built.file} ({built.vademecum_id[:12]}), {patient.fidelity}, in "
            f"{built.seconds:.1f} s"
        )
        return built

    async def _answer(
        self, request: InterpolatePatient.Request, response: InterpolatePatient.Response
    ) -> InterpolatePatient.Response:
        try:
            _fill(response, await self._beside.done(lambda: self.build(request)))
        # a service always answers; the surface decides which error is raised
        except Exception as error:
            self._refuse("interpolate_patient", response, error)
        return response

    async def _pursue(self, goal: Any) -> BuildPatient.Result:
        result = BuildPatient.Result()

        def tell(stage: Stage) -> None:
            goal.publish_feedback(BuildPatient.Feedback(**asdict(stage)))

        def work() -> Built | Previewed:
            return self.build(goal.request, tell, lambda: goal.is_cancel_requested)

        try:
            _fill(result, await self._beside.done(work))
            goal.succeed()
        except Exception as error:  # as above
            self._refuse("build_patient", result, error)
            if isinstance(error, CancelledError) and goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
        return result

    def _refuse(self, what: str, answer: Any, error: Exception) -> None:
        answer.success = False
        answer.message = one_line(error)
        answer.displacement_error = math.nan
        text = f"{what}: {answer.message}"
        if isinstance(error, BusyError | CancelledError):
            self.get_logger().warning(text)
        else:  # on a line of its own: rclpy allows only one severity for each line of code
            self.get_logger().error(text)


def _fill(answer: Any, built: Built | Previewed) -> None:
    if isinstance(built, Previewed):
        answer.boundary = conversions.surface_mesh(built.vertices, built.faces)
        answer.regions = array("B", built.regions.tobytes())
        answer.missed = conversions.surface_mesh(*built.missed)
        answer.notices, answer.seconds = built.notices, built.seconds
        answer.displacement_error = math.nan
        answer.message = "previewed; no file was written"
        answer.success = True
        return
    for name, value in asdict(built).items():
        setattr(answer, name, value)
    answer.message = f"written after {built.seconds:.2f} s"
    answer.success = True


def main() -> int:
    """Run the node; return the exit code."""
    return run(PatientInterpolationNode)


if __name__ == "__main__":
    raise SystemExit(main())
