"""Experiments: those of the paper and ours, each with its rivals in the same run.

Folders of livers come in; tables, JSON and pictures go out. Only the command imports this package.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avatar_core.studies.study import Study

# One module each, with an underscore for a hyphen, that holds its Study as STUDY.
NAMES = (
    "meshes",
    "grid",
    "in-silico",
    "samples",
    "leave-one-out",
    "transport",
    "atlas-size",
    "pgd",
    "coordinates",
    "resection",
    "certainty",
    "accuracy-time",
    "passivity",
    "contact",
    "indentation",
    "grasp",
    "registration",
)


def load_study(name: str) -> Study[Any]:
    """Return the study of that name, one of :data:`NAMES`."""
    module = import_module(f"{__name__}.{name.replace('-', '_')}")
    study: Study[Any] = module.STUDY
    return study
