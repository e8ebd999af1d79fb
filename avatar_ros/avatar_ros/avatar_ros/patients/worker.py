"""The worker process that keeps the atlas and builds patients.

Run as ``python -m avatar_ros.patients.worker JSON`` by ``PatientBuilder``, never by hand.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from avatar_core.atlas.base import PatientBase, base_of, numbers_of
from avatar_core.atlas.patient import (
    Fidelity,
    Patient,
    PatientOptions,
    build_patient,
    patient_vademecum,
    posed_patient,
    require_fidelity,
)
from avatar_core.atlas.patient_problem import PatientProblem, missed_part
from avatar_core.atlas.storage import load_atlas
from avatar_core.common.child import line_to_starter
from avatar_core.errors import one_line
from avatar_core.geometry.groups import read_groups
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.rule import Progress
from avatar_core.offline.supports import SupportOption
from avatar_core.vademecum import storage
from avatar_core.vademecum.display import boundary
from avatar_ros.framework import realtime
from avatar_ros.framework.library import RefusedError
from avatar_ros.framework.reader import Reader
from avatar_ros.patients.protocol import (
    ACCESSIBLE,
    CLAMPED,
    FIRST_SPRING,
    FREE,
    BuildError,
    BuildRefused,
    BuildSettings,
    Built,
    PatientRequest,
    Previewed,
    Ready,
    Stage,
)
from avatar_ros.patients.surface import read_confined, read_inside

_MAX_BYTES = 1 << 30  # largest unpacked size of a surface [bytes]
_NICENESS = 10  # gives way to a contact loop on the same machine


@dataclass(frozen=True, eq=False)
class LoadedAtlas:
    """Atlas that patients are built from; ``volumes`` [m3] by name of the anatomy."""

    base: PatientBase
    volumes: dict[str, float]

    @classmethod
    def load(cls, path: str) -> LoadedAtlas:
        """Load the atlas; raise AvatarError if it cannot be read or has no responses."""
        atlas = load_atlas(path)
        return cls(base_of(atlas), {one.name: one.volume for one in atlas.anatomies})


def build(
    request: PatientRequest,
    atlas: LoadedAtlas,
    settings: BuildSettings,
    reader: Reader,
    connection: Connection,
) -> Built | Previewed:
    """Build one patient and write it, or preview its regions.

    Raises
    ------
    AvatarError, OSError
        If nothing was written.
    """
    first, base = "", atlas.base

    def report(stage: str, fraction: float, error: float) -> None:
        connection.send(Stage(stage, min(float(fraction), 1.0), float(error), first))

    require_fidelity(request.fidelity)
    options = _options(request, atlas.base, settings)
    if not request.preview:
        require_replaceable(Path(request.output), reader)
    report("surface", 0.0, math.nan)
    surface = read_confined(request, reader)
    options = replace(options, groups=_groups(request, reader))
    fidelity: Fidelity = request.fidelity  # type: ignore[assignment]
    if request.preview:
        problem, _ = posed_patient(surface, atlas.base, fidelity, options, report)
        previewed = preview_of(problem, options.supports)
        connection.send(previewed)
        return previewed
    options = replace(options, inside=read_inside(request, reader))
    if request.interpolated_first and fidelity != "interpolated":
        base = write_first(surface, base, options, Path(request.output), report)
        first = os.path.basename(request.output)
    patient = patient_vademecum(surface, base, fidelity, options, report)
    report("save", 0.0, math.nan)
    with _uninterrupted():
        require_replaceable(Path(request.output), reader)
        identity = storage.save_vademecum(patient.vademecum, request.output)
        built = _result_of(patient, identity, surface, atlas, request)
        connection.send(built)
    return built


def write_first(
    surface: SurfaceMesh, base: PatientBase, options: PatientOptions, file: Path, report: Progress
) -> PatientBase:
    """Write an interpolated vademecum; return the base, which then knows the registration."""
    problem, weights = posed_patient(surface, base, "interpolated", options, report)
    patient = build_patient(problem, base, weights, "interpolated", options, report)
    with _uninterrupted():
        storage.save_vademecum(patient.vademecum, file)
    return replace(base, registration_of=lambda _: problem.registration)


def preview_of(problem: PatientProblem, supports: Sequence[SupportOption]) -> Previewed:
    """Return the boundary of a patient's mesh with its regions."""
    vertices, faces = boundary(problem.mesh)
    regions = np.where(problem.regions.accessible, ACCESSIBLE, FREE)
    regions[problem.regions.clamped] = CLAMPED
    springs = {spring.name: spring.faces for spring in problem.elasticity.supports}
    for k, support in enumerate(supports):  # clamped supports have no springs
        if support.name in springs:
            regions[springs[support.name]] = FIRST_SPRING + k
    notices = [*problem.surface.notices, *problem.notices, *problem.registration.notices]
    return Previewed(vertices, faces, regions.astype(np.uint8), missed_part(problem), notices)


def _groups(request: PatientRequest, reader: Reader) -> dict[str, np.ndarray] | None:
    if not request.groups:
        return None
    size = os.path.getsize(request.groups)
    return reader.read(os.path.basename(request.groups), size, read_groups, request.groups)


def require_replaceable(path: Path, reader: Reader) -> None:
    """Raise BuildError unless the path is free or holds a vademecum: an atlas must stay."""
    if not os.path.lexists(path):
        return
    if not path.is_symlink() and path.is_file():
        with contextlib.suppress(RefusedError):
            if reader.read(path.name, 0, storage.is_vademecum, path):
                return
    raise BuildError(f"{path.name} exists and is no vademecum; choose another name")


def volume_error(patient: Patient, volume: float, volumes: dict[str, float]) -> float:
    """Return |sum w_j V_j / V - 1|: error of the responses' weights when applied to volumes [-]."""
    combined = sum(
        w * volumes[name] for name, w in zip(patient.neighbors, patient.weights, strict=True)
    )
    return abs(float(combined) / volume - 1.0)


def displacement_error(patient: Patient) -> float:
    """Return the error that the certificate measured, else the estimate, else NaN [-]."""
    if patient.vademecum.certificate is not None:
        return float(patient.vademecum.certificate.l2_mean)
    return float(patient.estimates[-1].mean) if patient.estimates else math.nan


def _options(request: PatientRequest, base: PatientBase, settings: BuildSettings) -> PatientOptions:
    default = PatientOptions()
    left_out = numbers_of(base, request.leave_out)
    if len({*left_out, *base.copies}) == len(base.names):
        raise BuildError("no anatomy is left in the atlas; leave out fewer")
    return PatientOptions(
        n_vertices=settings.n_vertices,
        weighting=settings.weighting,  # type: ignore[arg-type]
        n_neighbors=request.neighbors or None,
        tolerance=default.tolerance if request.tolerance == 0.0 else request.tolerance,
        max_modes=settings.max_modes,
        n_certified=None if settings.n_certified < 0 else settings.n_certified,
        leave_out=left_out,
        supports=tuple(SupportOption.parse(text) for text in request.supports),
    )


def _result_of(
    patient: Patient,
    identity: str,
    surface: SurfaceMesh,
    atlas: LoadedAtlas,
    request: PatientRequest,
) -> Built:
    weights = np.asarray(patient.weights, dtype=float)
    return Built(
        vademecum_id=identity,
        file=os.path.basename(request.output),
        neighbors=list(patient.neighbors),
        weights=weights.tolist(),
        weight_abs_sum=patient.barycenter.absolute_sum,
        hull_distance=float(patient.barycenter.hull_distance),
        volume_error=volume_error(patient, surface.volume, atlas.volumes),
        displacement_error=displacement_error(patient),
        notices=[*surface.notices, *patient.notices],
    )


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """Delay SIGTERM: a file is written as a whole, and then reported."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})


def serve(settings: BuildSettings, connection: Connection) -> None:
    """Load the atlas, then build each request until the connection is closed."""
    try:
        atlas = LoadedAtlas.load(settings.atlas)
    except Exception as error:  # whatever a file provokes, the node reports it in one line
        connection.send(BuildRefused(one_line(error)))
        return
    connection.send(Ready(len(atlas.base.names)))
    reader = Reader(_MAX_BYTES)
    while True:
        request = connection.recv()
        try:
            build(request, atlas, settings, reader, connection)
        except (BrokenPipeError, EOFError):
            raise
        except Exception as error:  # as above
            connection.send(BuildRefused(one_line(error)))


def main() -> int:
    """Serve as the worker process; return the exit code."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    realtime.die_with_parent(signal.SIGTERM)
    os.nice(_NICENESS)
    with line_to_starter() as connection:
        serve(BuildSettings(**json.loads(sys.argv[1])), connection)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
