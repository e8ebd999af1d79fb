"""Bands of a model's forces, in the worker process.

They take about a second for each organ. While a value with a known distribution changes, they take
next to no time. Core modules are imported where they are used, because the contact node needs none
of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from avatar_core.errors import CoordinateError, one_line
from avatar_core.uncertainty.distributions import Distribution, of_mappings
from avatar_core.uncertainty.known import Held

if TYPE_CHECKING:
    from avatar_core.scene.prepare import ModelSpec


class BandPreparer:
    """Prepares bands; it keeps the edges for the last organ, tools and distributions."""

    def __init__(self) -> None:
        self._key: Any = None
        self._edges: Any = None

    def prepare(
        self, spec: ModelSpec, uncertainty: Mapping[str, Any]
    ) -> tuple[dict[str, Any], dict[str, np.ndarray], tuple[str, ...]]:
        """Prepare the bands of a model.

        Returns
        -------
        held : dict
            Plain form of :class:`avatar_core.uncertainty.known.Held`.
        arrays : dict
            Arrays of :class:`avatar_core.contact.force_band.ForceBand`, by name; empty without a
            usable distribution.
        notices : tuple of str
            One line on each unused distribution.
        """
        from avatar_core.contact.effects import Tumour
        from avatar_core.contact.effects.base import find

        if not uncertainty:
            return Held.by(spec.vademecum).plain(), {}, ()
        tumour = find(spec.effects, Tumour) or Tumour(1.0)
        vademecum = tumour.adapted(spec.vademecum)
        held = Held.by(vademecum)
        used, notices = usable_known(vademecum.name, held, of_mappings(uncertainty, "uncertainty"))
        arrays = self._arrays(vademecum, spec.tips, held.known(used)) if used else {}
        return held.plain(), arrays, notices

    def _arrays(
        self, vademecum: Any, tips: tuple[Any, ...], known: dict[str, Distribution]
    ) -> dict[str, np.ndarray]:
        from avatar_core.contact.force_band import DEPTH, RATIO
        from avatar_core.uncertainty.force_ratios import DEPTHS, log_edges, log_forces

        different = list(dict.fromkeys(tips))
        key = (vademecum.id, different, known)
        if key != self._key:
            self._key, self._edges = key, log_edges(vademecum, different, known)
        ratio = self._edges - log_forces(vademecum, different)[..., None]
        own = [different.index(tip) for tip in tips]
        return {RATIO: np.ascontiguousarray(ratio[own], np.float32), DEPTH: DEPTHS}


def usable_known(
    organ: str, held: Held, given: Mapping[str, Distribution]
) -> tuple[dict[str, Distribution], tuple[str, ...]]:
    """Split distributions into those that a vademecum can use, and notices on the others.

    The node keeps its parameters from one organ to the next. Young's modulus comes first, because
    the ranges of supports depend on it.

    organ : name of the vademecum
    """
    used: dict[str, Distribution] = {}
    notices = []
    for name in sorted(given, key=lambda name: name != "young"):
        try:
            held.known(used | {name: given[name]})
        except CoordinateError as error:
            notices.append(f"the distribution of {name} is not used in {organ}: {one_line(error)}")
        else:
            used[name] = given[name]
    return used, tuple(notices)
