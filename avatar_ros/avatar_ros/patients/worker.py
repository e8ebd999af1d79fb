"""The process that keeps the atlas and builds patients.

Run as ``python -m avatar_ros.patients.worker JSON`` by ``PatientBuilder``, never by hand.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from avatar_core.atlas.base import PatientBase, base_of, numbers_of
from avatar_core.atlas.patient import (
    Fidelity,
    Patient,
    PatientOptions,
    patient_vademecum,
    require_fidelity,
)
from avatar_core.atlas.storage import load_atlas
from avatar_core.errors import one_line
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.vademecum import storage
from avatar_ros.framework import realtime
from avatar_ros.framework.library import RefusedError
from avatar_ros.framework.reader import Reader
from avatar_ros.patients.builder import BuildError, Built, Order, Ready, Refused, Rules, Stage
from avatar_ros.patients.surface import read_confined

_LARGEST = 1 << 30  # surface, unpacked [bytes]
_NICENESS = 10  # a contact loop on the same machine goes first


@dataclass(frozen=True, eq=False)
class Source:
    """The atlas as patients need it; ``volumes`` [m3] by name of the anatomy."""

    base: PatientBase
    volumes: dict[str, float]

    @classmethod
    def load(cls, path: str) -> Source:
        """Raises AvatarError if the atlas cannot be read or has no responses."""
        atlas = load_atlas(path)
        return cls(base_of(atlas), {one.name: one.volume for one in atlas.anatomies})


def build(order: Order, source: Source, rules: Rules, reader: Reader, notes: Connection) -> Built:
    """Build one patient and write it.

    Raises
    ------
    AvatarError, OSError : nothing was written
    """

    def report(stage: str, fraction: float, error: float) -> None:
        notes.send(Stage(stage, min(float(fraction), 1.0), float(error)))

    require_fidelity(order.fidelity)
    options = _options(order, source.base, rules)
    require_replaceable(Path(order.output), reader)
    report("surface", 0.0, math.nan)
    surface = read_confined(order, reader)
    fidelity: Fidelity = order.fidelity  # type: ignore[assignment]
    patient = patient_vademecum(surface, source.base, fidelity, options, report)
    report("save", 0.0, math.nan)
    with _uninterrupted():
        require_replaceable(Path(order.output), reader)
        storage.save_vademecum(patient.vademecum, order.output)
        built = _account(patient, surface, source, order)
        notes.send(built)
    return built


def require_replaceable(path: Path, reader: Reader) -> None:
    """Raise BuildError unless there is nothing at the path, or a vademecum: an atlas must stay."""
    if not os.path.lexists(path):
        return
    if not path.is_symlink() and path.is_file():
        with contextlib.suppress(RefusedError):
            if reader.read(path.name, 0, storage.is_vademecum, path):
                return
    raise BuildError(f"{path.name} exists and is no vademecum; choose another name")


def volume_error(patient: Patient, volume: float, volumes: dict[str, float]) -> float:
    """|sum w_j V_j / V - 1|: how well the weights that combine responses combine volumes [-]."""
    combined = sum(
        w * volumes[name] for name, w in zip(patient.neighbours, patient.weights, strict=True)
    )
    return abs(float(combined) / volume - 1.0)


def displacement_error(patient: Patient) -> float:
    """Measured by the certificate, else estimated, else NaN [-]."""
    if patient.vademecum.certificate is not None:
        return float(patient.vademecum.certificate.l2_mean)
    return float(patient.estimates[-1].mean) if patient.estimates else math.nan


def _options(order: Order, base: PatientBase, rules: Rules) -> PatientOptions:
    default = PatientOptions()
    left_out = numbers_of(base, order.leave_out)
    if len({*left_out, *base.copies}) == len(base.names):
        raise BuildError("no anatomy is left in the atlas; leave out fewer")
    return PatientOptions(
        n_vertices=rules.n_vertices,
        weighting=rules.weighting,  # type: ignore[arg-type]
        n_neighbors=order.neighbors or None,
        tolerance=default.tolerance if order.tolerance == 0.0 else order.tolerance,
        max_modes=rules.max_modes,
        n_certified=None if rules.n_certified < 0 else rules.n_certified,
        leave_out=left_out,
    )


def _account(patient: Patient, surface: SurfaceMesh, source: Source, order: Order) -> Built:
    weights = np.asarray(patient.weights, dtype=float)
    return Built(
        vademecum_id=storage.file_id(order.output),
        file=os.path.basename(order.output),
        neighbours=list(patient.neighbours),
        weights=weights.tolist(),
        weight_abs_sum=patient.barycenter.absolute_sum,
        hull_distance=float(patient.barycenter.hull_distance),
        volume_error=volume_error(patient, surface.volume, source.volumes),
        displacement_error=displacement_error(patient),
        notices=[*surface.notices, *patient.notices],
    )


@contextlib.contextmanager
def _uninterrupted() -> Iterator[None]:
    """SIGTERM has to wait: a file is written as a whole, and then reported."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})


def serve(rules: Rules, notes: Connection) -> None:
    """Load the atlas, then build what is ordered until the line is closed."""
    try:
        source = Source.load(rules.atlas)
    except Exception as error:  # whatever a file provokes, the node says it in one line
        notes.send(Refused(one_line(error)))
        return
    notes.send(Ready(len(source.base.names)))
    reader = Reader(_LARGEST)
    while True:
        order = notes.recv()
        try:
            build(order, source, rules, reader, notes)
        except (BrokenPipeError, EOFError):
            raise
        except Exception as error:  # as above
            notes.send(Refused(one_line(error)))


def main() -> int:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    realtime.die_with_parent(signal.SIGTERM)
    os.nice(_NICENESS)
    notes = Connection(os.dup(sys.stdin.fileno()))
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the node is gone
        serve(Rules(**json.loads(sys.argv[1])), notes)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
