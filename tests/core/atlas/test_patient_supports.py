"""A patient that supports hold, where the template has them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from avatar_core.atlas.base import PatientBase, PatientError
from avatar_core.atlas.patient import PatientOptions, patient_vademecum, reduced
from avatar_core.atlas.patient_problem import PatientProblem, patient_problem, template_places
from avatar_core.atlas.transfer import patient_weights
from avatar_core.errors import MaterialError
from avatar_core.fem.patch_loads import patch_loads
from avatar_core.geometry.attachments import attachments_by_rule
from avatar_core.geometry.mesh import TetMesh
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.supports import SupportOption
from avatar_core.reduction.galerkin import ReductionRule
from avatar_core.shapes.registration import Registration
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from tests.helpers.bent_base import bent_phantoms, patient_mesh

pytestmark = pytest.mark.long  # it builds organs

HELD = tuple(SupportOption.parse(text) for text in ("cava_groove", "bare_area=3e6"))


@dataclass(frozen=True)
class Bent:
    """A patient outside a base of bent phantoms."""

    base: PatientBase
    surface: SurfaceMesh
    registration: Registration
    mesh: TetMesh

    def problem(self, *supports: SupportOption, **groups: np.ndarray) -> PatientProblem:
        return patient_problem(
            self.surface, self.base, self.registration, self.mesh, groups or None, supports
        )


@pytest.fixture(scope="module")
def bent() -> Bent:
    return Bent(*bent_phantoms(), patient_mesh())


def test_attachments_lie_where_the_registered_template_has_them(bent: Bent) -> None:
    registered = bent.registration.mesh
    for name, faces in attachments_by_rule(bent.base.template.mesh).items():
        here = template_places(bent.registration, bent.mesh)[name]
        own = bent.mesh.vertices[bent.mesh.boundary_faces[here]].mean(axis=1)
        there = registered.vertices[registered.boundary_faces[faces]].mean(axis=1)
        area, expected = bent.mesh.face_areas[here].sum(), registered.face_areas[faces].sum()
        # strips are one triangle wide on meshes this coarse
        assert area == pytest.approx(expected, rel=0.6)
        assert np.linalg.norm(own.mean(axis=0) - there.mean(axis=0)) < bent.mesh.mean_surface_edge


def test_supports_hold_instead_of_the_clamp(bent: Bent) -> None:
    problem = bent.problem(*HELD)
    assert not problem.regions.clamped.any()
    stiffness = {support.name: support.stiffness for support in problem.elasticity.supports}
    assert stiffness == {"cava_groove": 5e7, "bare_area": 3e6}
    held = np.any([support.faces for support in problem.elasticity.supports], axis=0)
    assert not (held & problem.regions.accessible).any()


def test_groups_put_a_support_elsewhere_and_add_a_clamp(bent: Bent) -> None:
    middle = bent.mesh.vertices[bent.mesh.boundary_faces].mean(axis=1)
    left, right = middle[middle[:, 0] < -0.04], middle[middle[:, 0] > 0.04]
    problem = bent.problem(SupportOption.parse("dome=1e6"), dome=left, clamped=right)
    (dome,) = problem.elasticity.supports
    assert dome.faces.any() and middle[dome.faces, 0].max() < 0.0
    assert problem.regions.clamped.any() and middle[problem.regions.clamped, 0].min() > 0.0


def test_stiff_supports_are_the_clamp_of_their_faces(bent: Bent) -> None:
    clamped, stiff, soft = (
        bent.problem(SupportOption.parse(f"bare_area={value}"))
        for value in ("clamped", "1e12", "1e6")
    )
    loads = patch_loads(clamped.elasticity, clamped.loads.centers[::9], 14e-3).tocsr()
    expected = clamped.elasticity.solve(loads)
    off = [np.linalg.norm(p.elasticity.solve(loads) - expected) for p in (stiff, soft)]
    assert off[0] < 0.01 * np.linalg.norm(expected) < off[1]


@pytest.mark.parametrize("fidelity", [pytest.param("reduced", marks=pytest.mark.long), "solved"])
def test_a_patient_on_supports_is_that_of_full_finite_elements(
    bent: Bent, fidelity: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    options = PatientOptions(
        n_vertices=350,
        tolerance=0.05,
        n_certified=8,
        supports=HELD,
        reduction=ReductionRule(n_start=20, n_block=6, n_probes=8, max_solution_fraction=0.6),
    )
    base = replace(bent.base, registration_of=lambda _: bent.registration)
    found = patient_vademecum(bent.surface, base, fidelity, options).vademecum  # type: ignore[arg-type]
    assert found.certificate is not None and found.certificate.l2_mean < 0.1
    file = tmp_path_factory.mktemp("held") / f"{fidelity}.h5"
    save_vademecum(found, file)
    assert [s.name for s in load_vademecum(file).supports] == ["cava_groove", "bare_area"]
    assert any("cava_groove=5e+07" in one for one in found.provenance.parameters)


def test_what_holds_nothing_or_needs_another_build_is_refused(bent: Bent) -> None:
    with pytest.raises(PatientError, match="one stiffness each"):
        PatientOptions(supports=(SupportOption.parse("bare_area=1e5:1e9"),))
    with pytest.raises(PatientError, match="choose reduced or solved"):
        patient_vademecum(bent.surface, bent.base, "interpolated", PatientOptions(supports=HELD))
    with pytest.raises(MaterialError, match="nothing holds the organ"):
        problem = bent.problem(SupportOption("falciform", 1.0))
        weights = patient_weights(bent.base, bent.registration, bent.surface)
        reduced(problem, bent.base, weights, PatientOptions())
