"""Calibration for a service: a separate process reads the files and computes."""

from __future__ import annotations

import math
import threading
import time
from pathlib import Path
from typing import Any

from avatar_core.common.confined import Confined, ConfinedError, Imported
from avatar_interfaces.srv import CalibrateMaterial
from avatar_ros.framework.library import RefusedError, find_in_library

_CALIBRATED = Imported("avatar_core.bags.touched", "calibrated_files")
_BYTES = 6 << 30  # address space of the process [bytes]
_SECONDS = 600.0  # limit of processor time [s]


class Calibrator:
    """Calibration service that answers one request at a time.

    Parameters
    ----------
    library_dir : str
        Directory of the files.
    max_bytes : int
        Largest size of a file.
    """

    def __init__(self, library_dir: str, max_bytes: int) -> None:
        self._library_dir, self._max_bytes = library_dir, max_bytes
        self._confined = Confined(_BYTES)
        self._busy = threading.Lock()

    def answered(
        self, request: CalibrateMaterial.Request, loaded: str, response: CalibrateMaterial.Response
    ) -> CalibrateMaterial.Response:
        """Fill the answer; this takes up to a minute.

        Parameters
        ----------
        request, response : messages of CalibrateMaterial
            Request, and the response to fill.
        loaded : str
            Vademecum to use if the request names none.

        Raises
        ------
        AvatarError
            If a field is refused, or the files give no calibration.
        """
        if not self._busy.acquire(blocking=False):
            raise RefusedError("another calibration is being computed; ask again after it")
        begin = time.monotonic()
        try:
            told = self._confined.call(_SECONDS, _CALIBRATED, *self._arguments(request, loaded))
        except ConfinedError as error:
            raise RefusedError(f"{error}; check the files, or use 'avatar calibrate'") from error
        finally:
            self._confined.close()
            self._busy.release()
        for name, value in _fields(told).items():
            setattr(response, name, value)
        response.seconds = time.monotonic() - begin
        response.success = True
        return response

    def stop(self) -> None:
        """Stop a computation that is running, if any."""
        self._confined.kill()

    def _arguments(self, request: CalibrateMaterial.Request, loaded: str) -> tuple[Any, ...]:
        """Return the arguments of ``calibrated_files``."""
        name = request.name or loaded
        if not name:
            raise RefusedError("no vademecum was loaded; load one, or give name")
        if not request.recording:
            raise RefusedError("recording is empty; give a bag or a recording in library_dir")
        if not (math.isfinite(request.radius) and request.radius >= 0.0):
            raise RefusedError(f"radius is {request.radius:g} m; give a positive one, or 0")
        transform = tuple(request.tool_transform)
        if len(transform) not in (0, 7):
            raise RefusedError(
                f"tool_transform has {len(transform)} numbers; give position and quaternion, seven"
            )
        return (
            self._file(name),
            self._file(request.recording),
            request.tool or None,
            transform or None,
            request.radius or None,
            list(request.given),
        )

    def _file(self, name: str) -> Path:
        return find_in_library(name, self._library_dir, self._max_bytes)


def _fields(told: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of an answer, from the numbers of a calibration."""
    found = [told["values"][name] for name in told["parameters"]]
    return {
        "message": told["verdict"],
        "explained": told["explained"],
        "probability": told["probability"],
        "parameters": told["parameters"],
        "values": [one["value"] for one in found],
        "low": [one["low"] for one in found],
        "high": [one["high"] for one in found],
    }
