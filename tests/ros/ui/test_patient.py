"""A new patient on the planning page: its labels, its painted clamp and springs, its tab."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from viser import ViserServer

from avatar_core.common.supports import ATTACHMENTS
from avatar_core.geometry.groups import faces_of_groups, read_groups, regions_of_groups
from avatar_core.offline.supports import SupportOption
from avatar_ros.framework.conversions import surface_mesh
from avatar_ros.patients.protocol import ACCESSIBLE, CLAMPED, FIRST_SPRING, stem
from avatar_ros.ui.patient.new_patient import NewPatient
from avatar_ros.ui.patient.preview_view import BRUSHES
from avatar_ros.ui.session.requests import Wanted
from avatar_ros.ui.tabs.inside import InsideTab
from avatar_ros.ui.tabs.patient import FREE, GUESS, INSIDE, ORGAN, SPRUNG, PatientTab
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.structures_view import STRUCTURE
from tests.helpers.slowness import Deadline
from tests.ros.helpers.page import AtOnce, Noted, face_area, image


class Cell(Noted):
    """Stand-in that builds at once; it notes requests, and the state of tab and view.

    drawn : regions of the faces, for each drawing of the preview
    springs : areas that the tab shows [m^2]
    """

    def __init__(self, result: Any) -> None:
        super().__init__(
            build_patient=self._build, show=self._show, show_preview=self._show_preview
        )
        self.result, self.drawn = result, list[np.ndarray]()
        self.springs: dict[str, float] = {}

    def _build(self, wanted: Wanted, progress: Any, report: Any, then: Any, first: Any) -> None:
        if wanted.interpolated_first:
            first("first.h5")
        then(self.result)

    def _show(self, points: Any, faces: Any, regions: np.ndarray, missed: Any) -> None:
        self.drawn.append(regions)
        self.missed = missed

    def _show_preview(self, is_shown: bool, springs: dict[str, float] | None = None) -> None:
        self.springs = springs or {}

    @property
    def asked(self) -> Wanted:
        """Return the request of the last build."""
        return self.of("build_patient")[-1]


@pytest.fixture
def cell(cube: Organ) -> Cell:
    """Return the surface of a cube's mesh, clamped and reached as its vademecum."""
    at = cube.vademecum.regions
    regions = np.where(at.accessible, ACCESSIBLE, 0)
    regions[at.clamped] = CLAMPED
    boundary = surface_mesh(cube.vertices, cube.faces)
    missed = surface_mesh(cube.vertices[cube.faces[0]] + 0.01, np.array([[0, 1, 2]]))
    return Cell(SimpleNamespace(boundary=boundary, regions=regions, missed=missed, file="x.h5"))


@pytest.fixture
def new(cell: Cell, tmp_path: Path) -> NewPatient:
    parts: Any = (AtOnce(), cell, lambda: cell, cell, cell.built, cell.say)
    return NewPatient(tmp_path, *parts)


def towards(cube: Organ, face: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a ray from outside to the middle of a face of the cube."""
    corners = cube.vertices[cube.faces[face]].astype(float)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    return corners.mean(axis=0) + 0.05 * normal, -normal


def test_painted_regions_reach_the_next_build_of_that_organ_alone(
    new: NewPatient, cell: Cell, cube: Organ, tmp_path: Path
) -> None:
    wanted = Wanted("cube.stl", fidelity="reduced", preview=True)
    new.build(wanted)
    assert new.is_previewing and cell.of("show_preview") == [True]
    assert "hidden" in new.alerts("liver")[0]
    points, faces = cell.missed
    np.testing.assert_allclose(points, cube.vertices[cube.faces[0]] + 0.01)
    assert faces.tolist() == [[0, 1, 2]]
    free = int(np.flatnonzero(cell.drawn[-1] == 0)[0])
    ray = towards(cube, free)
    new.paint(*ray)  # without a brush
    assert len(cell.drawn) == 1
    new.brush("clamp", 2e-3)
    new.paint(*ray)
    assert cell.drawn[-1][free] == CLAMPED
    assert (cell.drawn[-1] == CLAMPED).sum() > (cell.drawn[0] == CLAMPED).sum()
    new.build(Wanted("other.stl", fidelity="reduced"))
    assert cell.asked.groups == ""
    new.build(wanted._replace(preview=False, interpolated_first=True))
    assert cell.asked.groups == "cube-groups.npz"
    assert not cell.asked.interpolated_first  # its clamp is the template's
    painted = regions_of_groups(cube.vademecum.mesh, read_groups(tmp_path / "cube-groups.npz"))
    np.testing.assert_array_equal(painted.clamped, cell.drawn[-1] == CLAMPED)
    new.end_preview()
    assert not new.is_previewing and len([call for call in cell.calls if call[0] == "hide"]) == 1
    new.build(wanted._replace(preview=False))
    assert cell.asked.groups == ""


def test_springs_are_painted_by_name_and_kept_for_the_build(
    new: NewPatient, cell: Cell, cube: Organ, tmp_path: Path
) -> None:
    free = np.flatnonzero(cell.result.regions == 0)
    cell.result.regions[free[:2]] = FIRST_SPRING + 2  # by its place in the request
    wanted = Wanted(
        "cube.stl",
        fidelity="reduced",
        supports=("cava_groove", "bare_area=clamped", "falciform=1e6"),
        preview=True,
    )
    new.build(wanted)
    assert list(cell.springs) == ["cava_groove", "falciform"]  # a clamp is no spring
    assert cell.springs["cava_groove"] == 0.0
    assert cell.springs["falciform"] == pytest.approx(
        face_area(cube.vertices, cube.faces[free[:2]]), rel=1e-5
    )
    new.brush("cava_groove", 2e-3)
    new.paint(*towards(cube, free[-1]))
    assert cell.drawn[-1][free[-1]] == FIRST_SPRING and cell.springs["cava_groove"] > 0.0
    new.build(wanted._replace(preview=False))
    groups = read_groups(tmp_path / cell.asked.groups)
    assert set(groups) == {"clamped", "accessible", "cava_groove", "bare_area", "falciform"}
    # a clamp that was painted over must not come back from the template
    np.testing.assert_array_equal(groups["bare_area"], groups["clamped"])
    faces = faces_of_groups(cube.vademecum.mesh, groups)
    painted = cell.drawn[-1] == FIRST_SPRING
    assert faces["cava_groove"][painted].all() and not faces["falciform"][painted].all()
    new.build(wanted._replace(supports=("falciform", "cava_groove")))
    new.paint(*towards(cube, free[-1]))  # with the same brush, whose number is another now
    assert cell.drawn[-1][free[-1]] == FIRST_SPRING + 1
    new.build(wanted._replace(preview=False, supports=()))
    assert cell.asked.groups == ""  # springs were painted, and a clamp is requested


def test_a_patient_that_was_built_is_offered_and_the_organ_in_use_stays(
    new: NewPatient, cell: Cell, server: ViserServer, user: Noted
) -> None:
    tab = PatientTab(server.gui, user, user.load, tuple(BRUSHES))  # type: ignore[arg-type]
    new._tab = lambda: tab
    tab.begin()
    assert tab._cancel.visible and tab._progress.animated
    tab.show_progress("factorising", 0.5, float("nan"))
    assert not tab._progress.animated and tab._progress.value == 50.0
    new.build(Wanted("cube.stl", fidelity="reduced"))
    assert cell.of("built") == ["x.h5"] and not tab._cancel.visible
    assert not user.calls
    (use,) = tab._use._impl.update_cb
    use(None)
    assert user.of("load") == ["x.h5"] and not tab._use.visible
    new.build(Wanted("cube.stl", fidelity="reduced", preview=True))
    assert not tab._use.visible


def test_an_interpolated_organ_in_use_gives_way_to_the_better_one(
    new: NewPatient, cell: Cell, server: ViserServer, user: Noted
) -> None:
    tab = PatientTab(server.gui, user, user.load, tuple(BRUSHES))  # type: ignore[arg-type]
    new._tab = lambda: tab
    (use,) = tab._use._impl.update_cb

    def build(used: bool) -> None:
        def working(wanted: Wanted, progress: Any, report: Any, then: Any, first: Any) -> None:
            first("first.h5")
            assert tab._use.visible and tab._use.label == "Use first.h5 so far"
            if used:
                use(None)
            then(cell.result)

        new._requests = SimpleNamespace(build_patient=working)  # type: ignore[assignment]
        new.build(Wanted("cube.stl", fidelity="reduced", interpolated_first=True))

    build(used=False)
    assert not user.calls and tab._use.visible and tab._use.label == "Use x.h5"
    build(used=True)
    assert user.of("load") == ["first.h5", "x.h5"] and not tab._use.visible
    assert cell.of("built") == ["first.h5", "x.h5"] * 2


def test_labels_are_offered_of_a_label_map_alone(
    new: NewPatient, cell: Cell, tmp_path: Path
) -> None:
    labels = np.zeros((6, 6, 6), np.uint8)
    labels[1:4, 1:4, 1:4], labels[4, 4, 4] = 1, 7
    image(tmp_path / "case.nii.gz", labels)
    for file, offered in (("case.nii.gz", ("1", "7")), ("liver.stl", ())):
        before = len(cell.of("offer_labels"))
        new.choose_surface(file)
        passed = Deadline(60.0)
        while len(cell.of("offer_labels")) == before and not passed:
            time.sleep(0.01)
        assert cell.of("offer_labels")[-1] == offered


# --- The tab ----------------------------------------------------------------------------------


@pytest.fixture
def user() -> Noted:
    return Noted()


@pytest.fixture
def tab(server: ViserServer, user: Noted) -> PatientTab:
    return PatientTab(server.gui, user, user.load, tuple(BRUSHES))  # type: ignore[arg-type]


def test_labels_of_a_file_reach_the_build(tab: PatientTab, user: Noted) -> None:
    tab.offer(["case.nii.gz", "liver.stl"])
    assert user.of("choose_surface") == []  # a scan is not a patient that a user chose
    tab._ask()
    assert user.of("build") == [] and "choose a surface" in tab._stage.content
    tab._surfaces.value = "case.nii.gz"
    tab._unit.value, tab._axes.value = "cm", "LPS"  # from another file
    tab.offer_labels(("left lobe", "right lobe", "lesion", "vein"))
    assert not (tab._unit.visible or tab._axes.visible)  # a label map states both
    assert tab._wanted().unit == tab._wanted().axes == ""
    tab._ask()
    assert user.of("build") == [] and "which labels are the organ" in tab._stage.content
    for name, role in (("left lobe", ORGAN), ("right lobe", ORGAN), ("vein", INSIDE)):
        tab._roles[name].value = role
    tab._ask(preview=True)
    (wanted,) = user.of("build")
    assert (wanted.surface, wanted.label) == ("case.nii.gz", "left lobe,right lobe")
    assert wanted.inside == ("vein",) and wanted.preview
    tab.offer_labels(("liver",))
    assert tab._wanted().label == "liver"  # the only one
    tab.offer_labels(())
    assert tab._wanted().label == "" and tab._wanted().inside == ()
    assert tab._unit.visible and tab._wanted().unit == "cm"


def test_springs_are_asked_for_by_stiffness(tab: PatientTab, user: Noted) -> None:
    assert tab._wanted().supports == () and not tab._stiffness.visible
    assert not tab._wanted().interpolated_first
    tab._first.value = True
    assert tab._wanted().interpolated_first and not tab._wanted(preview=True).interpolated_first
    tab._held.value = SPRUNG
    assert not tab._wanted().interpolated_first
    assert tab._stiffness.visible
    for name in ATTACHMENTS:
        tab._springs[name].value = FREE
    tab._springs["bare_area"].value, tab._springs["falciform"].value = "1e6", GUESS
    tab._springs["cava_groove"].value = "clamped"
    assert tab._wanted().supports == ("cava_groove=clamped", "bare_area=1e6", "falciform")
    for text in tab._wanted().supports:
        SupportOption.parse(text)
    tab.show_preview(True, {"bare_area": 50e-4})
    assert "bare_area 50 cm" in tab._areas.content and tab._areas.visible
    tab._brush.value = "bare_area"
    assert user.calls[-1][:2] == ("brush", "bare_area")
    tab.show_preview(True, {"bare_area": 60e-4})
    assert tab._brush.value == "bare_area"  # painting goes on
    tab.show_preview(False)
    assert not tab._areas.visible and "bare_area" not in tab._brush.options


def test_structures_have_their_controls(server: ViserServer, user: Noted) -> None:
    inside = InsideTab(server.gui, user)  # type: ignore[arg-type]
    inside.show(("lesion", "vein"))
    inside._rows[2].value = 50
    assert user.calls[-1] == ("style", "lesion", True, STRUCTURE, 0.5)
    inside.show(())
    assert not inside._folder.visible


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("1.2.840.17.nii.gz", "1.2.840.17"),
        ("ct.seg.nrrd", "ct"),
        ("a.b.OBJ", "a.b"),
        ("organs.dcm", "organs"),
        ("liver", "liver"),
    ],
)
def test_files_of_two_patients_have_two_names(file: str, name: str) -> None:
    assert stem(file) == name
