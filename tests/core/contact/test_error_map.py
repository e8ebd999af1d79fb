"""Expected error of the force over the surface of an organ."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatar_core.contact.error_map import force_error_at
from avatar_core.vademecum.certificate import Certificate
from avatar_core.vademecum.force_error import ForceError
from tests.helpers.box_organ import UP, organ, top

FACTOR, FLOOR = 2.0, 0.01


def test_the_error_is_known_on_the_accessible_surface_alone() -> None:
    """It is at least factor times floor, doubles with the factor, and is NaN below the organ."""
    places = np.stack([top("cube"), top("cube") - 0.2 * UP])
    found = []
    for factor in (FACTOR, 2.0 * FACTOR):
        measured = replace(Certificate.unknown(), force_error=ForceError(factor, FLOOR))
        found.append(force_error_at(organ("cube").with_certificate(measured), places))
    assert found[0][0] >= FACTOR * FLOOR * (1.0 - 1e-6)
    np.testing.assert_allclose(found[1][0], 2.0 * found[0][0], rtol=1e-5)
    assert np.isnan(found[0][1]) and np.isnan(found[1][1])


def test_what_was_never_measured_has_no_error() -> None:
    blank = organ("cube").with_certificate(Certificate.unknown())
    assert np.isnan(force_error_at(blank, top("cube")[None])).all()
