"""An organ with a tumour and coordinates of its material, in a separate file for the cache."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import meshio
import numpy as np

from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.tumour import read_tumour
from avatar_core.offline.rule import BuildRule
from avatar_core.pipeline import OrganOptions, build
from avatar_core.reduction.coordinates import Coordinate
from avatar_core.vademecum.model import Vademecum
from tests.helpers.disk_cache import cached_on_disk
from tests.helpers.small_files import ball

BALL = 0.018  # radius of the tumour [m]


@cached_on_disk
def sick_organ() -> Vademecum:
    """Build a coarse phantom over Poisson's ratio and the contrast of a tumour."""
    liver = replace(phantom_liver(12e-3), name="sick")
    center = liver.vertices.mean(axis=0) + np.array([0.0, 0.03, 0.0])
    points, faces = ball(360, BALL)
    with TemporaryDirectory() as name:
        tumour = Path(name, "tumour.stl")
        meshio.write_points_cells(tumour, 1e3 * (center + points), {"triangle": faces})
        options = OrganOptions(
            n_displayed=0,
            n_vertices=600,
            rule=BuildRule(max_modes=20),
            coordinates=(
                Coordinate("poisson", 0.40, 0.49, 2),
                Coordinate("contrast", 0.5, 20.0, 3),
            ),
            tumour=read_tumour(tumour),
            n_certified=4,
        )
        return build(liver, options)
