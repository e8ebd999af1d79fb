"""Options of a build: values out of range are refused before any work."""

from __future__ import annotations

import pytest

from avatar_core.errors import AvatarError, CoordinateError
from avatar_core.fem.elasticity import Material
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.pipeline import OrganOptions, notices_of
from avatar_core.reduction.coordinates import Coordinate
from tests.helpers.soft_organ import soft_tumour

LOW, HIGH = Coordinate("poisson", 0.30, 0.40), Coordinate("poisson", 0.49, 0.499)
CONTRAST = Coordinate("contrast", 2.0, 20.0)


@pytest.mark.parametrize(
    ("poisson", "contrast", "reason"),
    [
        (0.45, 4.0, "poisson is 0.45, outside its range 0.3 to 0.4"),
        (0.35, 50.0, "contrast is 50, outside its range 2 to 20"),
        (0.35, 0.5, "contrast is 0.5, outside its range 2 to 20"),
    ],
)
def test_a_value_outside_the_range_of_its_coordinate_is_refused(
    poisson: float, contrast: float, reason: str
) -> None:
    with pytest.raises(CoordinateError, match=reason):
        OrganOptions(
            material=Material(poisson_ratio=poisson),
            contrast=contrast,
            coordinates=(LOW, CONTRAST),
            tumour=soft_tumour(),
        )


@pytest.mark.parametrize(("coordinate", "nearest"), [(LOW, "0.4"), (HIGH, "0.49")])
def test_a_default_outside_a_range_is_moved_into_it_and_said(
    coordinate: Coordinate, nearest: str
) -> None:
    options = OrganOptions(coordinates=(coordinate,))
    (notice,) = options.notices
    assert notice.startswith(f"poisson is {nearest} until one is chosen: its default 0.48 ")
    assert notices_of(phantom_liver(12e-3), options)[-1] == notice


def test_a_value_inside_its_range_is_not_spoken_of() -> None:
    sick = OrganOptions(contrast=4.0, coordinates=(CONTRAST,), tumour=soft_tumour())
    assert not sick.notices
    assert not OrganOptions(material=Material(poisson_ratio=0.35), coordinates=(LOW,)).notices


def test_a_seed_below_zero_is_refused() -> None:
    with pytest.raises(AvatarError, match="the seed is -1; give 0 or more"):
        OrganOptions(seed=-1)


def test_a_certificate_of_no_load_is_refused() -> None:
    with pytest.raises(AvatarError, match="0 loads certify nothing; give 1 or more"):
        OrganOptions(n_certified=0)
