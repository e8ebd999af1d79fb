"""The anatomies of a base: which get no weight, and where a patient with the shape of one lies."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from avatar_core.atlas.base import PatientBase, PatientError, leave_one_out
from avatar_core.atlas.patient_problem import template_problem
from avatar_core.atlas.transfer import patient_weights
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.registration import Registration
from tests.helpers.bent_base import bent_phantoms, registration_of

pytestmark = pytest.mark.long  # it builds organs


@dataclass(frozen=True)
class Bent:
    """A patient outside a base of bent phantoms."""

    base: PatientBase
    surface: SurfaceMesh
    registration: Registration


@pytest.fixture(scope="module")
def bent() -> Bent:
    return Bent(*bent_phantoms())


@pytest.fixture(scope="module")
def doubled(bent: Bent) -> PatientBase:
    """The base with phantom-1 again as phantom-2, elsewhere."""
    vertices = np.array(bent.base.vertices)
    vertices[2] = vertices[1] + [0.02, 0.0, 0.01]
    return replace(bent.base, vertices=vertices)


# --- left out -----------------------------------------------------------------------------------


def test_scans_of_one_person_are_left_out_together(bent: Bent) -> None:
    out = leave_one_out(bent.base, "phantom-1", [("phantom-1", "phantom-3")])
    assert out == [1, 3]
    weights = patient_weights(bent.base, bent.registration, bent.surface, leave_out=out)
    assert not set(out) & set(weights.neighbors)


@pytest.mark.parametrize("name", ["phantom-1", "phantom-2"])
def test_copies_are_left_out_together(doubled: PatientBase, name: str) -> None:
    assert leave_one_out(doubled, name, ()) == [1, 2]
    assert leave_one_out(doubled, name, [("phantom-4", "phantom-1")]) == [1, 2, 4]


@pytest.mark.parametrize("number", [1, 2])
def test_a_patient_left_out_gets_no_weight_by_its_copy(doubled: PatientBase, number: int) -> None:
    registration = registration_of(doubled.template, doubled.vertices[number])
    surface = SurfaceMesh(registration.mesh.vertices, registration.mesh.boundary_faces)
    found = patient_weights(doubled, registration, surface, leave_out=(number,))
    assert found.member is None
    assert sorted(found.neighbors) == [0, 3, 4]


@pytest.mark.parametrize("number", [99, 5, -1])
def test_a_number_that_the_base_lacks_is_refused(bent: Bent, number: int) -> None:
    with pytest.raises(PatientError, match=f"number {number} .* from 0 to 4"):
        patient_weights(bent.base, bent.registration, bent.surface, leave_out=(0, number))


# --- a member that lies elsewhere ---------------------------------------------------------------


def test_a_patient_with_the_shape_of_a_member_lies_where_it_is(bent: Bent) -> None:
    shift = np.array([0.1, 0.05, -0.02])
    here = registration_of(bent.base.template, np.asarray(bent.base.vertices[2]) + shift)
    surface = SurfaceMesh(here.mesh.vertices, here.mesh.boundary_faces)
    member = patient_weights(bent.base, here, surface).member
    assert member == 2
    problem = template_problem(surface, bent.base, here, member)
    still = registration_of(bent.base.template, bent.base.vertices[2])
    before = template_problem(surface, bent.base, still, member)
    assert np.array_equal(before.mesh.vertices, bent.base.vertices[2])
    np.testing.assert_allclose(problem.mesh.vertices, here.mesh.vertices, atol=1e-12)
    np.testing.assert_allclose(problem.loads.centers, before.loads.centers + shift, atol=1e-12)
