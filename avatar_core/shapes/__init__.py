"""Comparison of anatomies: level sets, registration to a template, LLE, kriging.

::

    lle = shapes.LLE(n_neighbors=10, n_components=2)      # paper, Eq. 15 and 16
    coordinates = lle.fit_transform(vectors)              # one shape a row
    weights = shapes.kriging(vectors, new, n_neighbors=64)
    blend = weights.combine(vectors)                      # Eq. 18

Surfaces and level sets come in. A template registered to each of them, the correspondence that
follows, and weights of neighbors go out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from avatar_core.common.lazy import lazy

_ORIGIN = {
    "Barycenter": "shapes.weights",
    "DistanceGrid": "geometry.level_set",
    "GridBox": "geometry.level_set",
    "LLE": "shapes.lle",
    "Registration": "shapes.registration",
    "ShapeMap": "geometry.phantom",
    "Template": "shapes.registration",
    "TemplateRule": "shapes.registration",
    "barycenter": "shapes.weights",
    "dice": "geometry.level_set",
    "distance_grid": "geometry.level_set",
    "distance_in_box": "geometry.level_set",
    "isosurface": "geometry.level_set",
    "kriging": "shapes.weights",
    "padded_box": "geometry.level_set",
    "population": "geometry.phantom",
    "register_template": "shapes.registration",
    "reinitialize": "geometry.level_set",
}

__all__ = [*_ORIGIN]

if TYPE_CHECKING:
    from avatar_core.geometry.level_set import DistanceGrid as DistanceGrid
    from avatar_core.geometry.level_set import GridBox as GridBox
    from avatar_core.geometry.level_set import dice as dice
    from avatar_core.geometry.level_set import distance_grid as distance_grid
    from avatar_core.geometry.level_set import distance_in_box as distance_in_box
    from avatar_core.geometry.level_set import isosurface as isosurface
    from avatar_core.geometry.level_set import padded_box as padded_box
    from avatar_core.geometry.level_set import reinitialize as reinitialize
    from avatar_core.geometry.phantom import ShapeMap as ShapeMap
    from avatar_core.geometry.phantom import population as population
    from avatar_core.shapes.lle import LLE as LLE
    from avatar_core.shapes.registration import Registration as Registration
    from avatar_core.shapes.registration import Template as Template
    from avatar_core.shapes.registration import TemplateRule as TemplateRule
    from avatar_core.shapes.registration import register_template as register_template
    from avatar_core.shapes.weights import Barycenter as Barycenter
    from avatar_core.shapes.weights import barycenter as barycenter
    from avatar_core.shapes.weights import kriging as kriging
else:
    __getattr__, __dir__ = lazy(__name__, _ORIGIN)
