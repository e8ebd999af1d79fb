"""The study of contacts: key figures from known contacts."""

from __future__ import annotations

import numpy as np
import pytest

from avatar_core.certify.contact_sites import Site, SiteContact
from avatar_core.geometry.tip import Tip
from avatar_core.studies.contact import reference_error, summary_of

SITE = Site("drawn", np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0)


def contact(force: float, estimate: float, angle: float = 0.0) -> SiteContact:
    """Return a contact with a resolved force of 2 N."""
    return SiteContact(
        SITE, Tip("sphere", 3e-3), 1e-3, 2.0, force, angle, estimate, 0.5 * estimate, 6.0, 1.0, 0.05
    )


def test_key_figures_are_those_of_the_contacts() -> None:
    found = summary_of(
        [contact(2.1, 0.2), contact(1.8, 0.1), contact(2.0, 0.1), contact(2.0, 0.0, 0.2)]
    )
    assert found["force_mean"] == pytest.approx((0.05 + 0.1) / 4)
    assert found["force_worst"] == pytest.approx(0.1)
    assert found["coverage"] == 0.75  # 1.8 N is 0.2 N off, with an estimate of 0.1 N
    assert found["patch_mean"] == pytest.approx(2.0)
    assert found["hertz_mean"] == pytest.approx(0.5)
    assert found["far_field_l2"] == found["far_field_l2_median"] == 0.05
    assert found["drawn_contacts"] == 4.0 and found["drawn_worst"] == pytest.approx(0.1)
    assert "edge_mean" not in found and "cone_mean" not in found
    assert found["direction_mean_deg"] == pytest.approx(np.degrees(0.05))


@pytest.mark.long
def test_the_reference_is_sneddons_on_a_cube() -> None:
    assert reference_error() < 0.02
