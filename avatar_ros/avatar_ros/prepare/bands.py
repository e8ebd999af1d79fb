"""The bands of the forces of a model, in the worker process.

They take a second or so for each organ, and next to nothing while a value changes of which the
distribution is known. Core modules are imported where they are used, because the contact node needs
none of them.
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
    """Prepares bands, and keeps the edges for the last organ, tools and distributions."""

    def __init__(self) -> None:
        self._key: Any = None
        self._edges: Any = None

    def prepare(
        self, spec: ModelSpec, uncertainty: Mapping[str, Any]
    ) -> tuple[dict[str, Any], dict[str, np.ndarray], tuple[str, ...]]:
        """What a model holds of its parameters, the arrays of its bands, and what is not used.

        Returns
        -------
        held : plain form of :class:`avatar_core.uncertainty.known.Held`
        arrays : of :class:`avatar_core.contact.force_band.ForceBand`, by name; none without a
            distribution that the vademecum has a place for
        notices : on each of the others, a line
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
    """Distributions that a vademecum has a place for, and what is said of each of the others.

    The node keeps its parameters from one organ to the next. Young's modulus comes first, as the
    ranges of supports depend on it.

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
