"""The parameters of the patient_interpolation node, and its settings."""

from __future__ import annotations

import os
from dataclasses import dataclass

from rclpy.node import Node

from avatar_ros.framework.parameters import AUTOSTART, Parameter, ParameterError, values
from avatar_ros.patients.protocol import BuildSettings

WEIGHTINGS = ("kriging", "lle-template", "lle-grid", "lle-paper")

PATIENT_INTERPOLATION = (
    AUTOSTART,
    Parameter(
        "atlas", "", "atlas of anatomies with responses, a folder made by 'avatar atlas create'"
    ),
    Parameter(
        "library_dir",
        ".",
        "directory of surfaces and results; nothing outside it is read or written",
    ),
    Parameter("max_megabytes", 256, "largest surface file or mesh that is read [MB]", (1, 1999)),
    Parameter(
        "vertices", 2850, "approximate number of vertices of a patient's mesh", range=(100, 50_000)
    ),
    Parameter("modes", 100, "largest number of modes at one load position", range=(1, 1000)),
    Parameter(
        "weighting",
        "kriging",
        "weights of the neighbors: kriging, lle-template, lle-grid or lle-paper",
    ),
    Parameter(
        "certify",
        -1,
        "unseen loads of the certificate; -1: 24, or 200 with fidelity solved",
        range=(-1, 10_000),
    ),
    Parameter("threads", 1, "threads of the numerical libraries", range=(1, 64)),
)


@dataclass(frozen=True)
class InterpolationSettings:
    """Parameters of the patient_interpolation node."""

    build: BuildSettings
    library_dir: str
    max_bytes: int
    threads: int


def read_interpolation(node: Node) -> InterpolationSettings:
    """Read the patient_interpolation node's parameters.

    Raises
    ------
    ParameterError
        If a value is not accepted; names the parameter and the accepted values.
    """
    value = values(node, PATIENT_INTERPOLATION)
    if not value["atlas"]:
        raise ParameterError(
            "parameter atlas: give the folder of an atlas, made by 'avatar atlas create'"
        )
    if value["weighting"] not in WEIGHTINGS:
        raise ParameterError(f"parameter weighting: give one of {', '.join(WEIGHTINGS)}")
    return InterpolationSettings(
        build=BuildSettings(
            atlas=os.path.abspath(os.path.expanduser(value["atlas"])),
            n_vertices=value["vertices"],
            max_modes=value["modes"],
            weighting=value["weighting"],
            n_certified=value["certify"],
        ),
        library_dir=os.path.expanduser(value["library_dir"]),
        max_bytes=value["max_megabytes"] * 1_000_000,
        threads=value["threads"],
    )
