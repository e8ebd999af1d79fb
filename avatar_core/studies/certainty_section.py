"""What sections of the study of certainty are made of, and their sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from avatar_core.studies.study import Panel, Value


@dataclass(frozen=True)
class CertaintySettings:
    """Sizes.

    n_vertices : of the mesh, about
    n_values : unseen values of a coordinate, beside the ends of its range
    n_loads : unseen load positions at each of them, three directions each
    max_modes : at a place
    n_draws : of the material, each solved in full
    n_places : that are pressed for them
    n_trials : of a calibration, each solved in full
    n_registrations : of each class of deformations
    """

    n_vertices: int = 2850
    n_values: int = 8
    n_loads: int = 12
    max_modes: int = 100
    n_draws: int = 1000
    n_places: int = 3
    n_trials: int = 100
    n_registrations: int = 4


@dataclass(frozen=True, eq=False)
class Section:
    """One question of the study and its answer.

    name : of its rows; the keys of its summary begin with it
    sentence : the finding, in one sentence
    summary, rows : as of :class:`avatar_core.studies.study.Run`
    panels : plots, each with its own sentence
    notices : what was done differently, or found on the way, one line each
    """

    name: str
    sentence: str
    summary: Mapping[str, float]
    rows: tuple[Mapping[str, Value], ...]
    panels: tuple[Panel, ...]
    notices: tuple[str, ...] = ()
