"""Sections of the study of certainty, and their sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from avatar_core.studies.study import Panel, Value


@dataclass(frozen=True)
class CertaintySettings:
    """Sizes of the sections.

    n_vertices : approximate number of mesh vertices
    n_values : unseen values of a coordinate, beside the ends of its range
    n_loads : unseen load positions at each of them, three directions each
    max_modes : largest number of modes at a place
    n_draws : draws of the material, each solved in full
    n_places : pressed places for these draws
    n_trials : trials of a calibration, each solved in full
    n_registrations : registrations of each class of deformations
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

    name : name of its rows; the keys of its summary begin with it
    sentence : the finding, in one sentence
    summary, rows : see :class:`avatar_core.studies.study.Run`
    panels : plots, each with its own sentence
    notices : deviations and findings on the way, one line each
    """

    name: str
    sentence: str
    summary: Mapping[str, float]
    rows: tuple[Mapping[str, Value], ...]
    panels: tuple[Panel, ...]
    notices: tuple[str, ...] = ()
