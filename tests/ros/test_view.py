"""What the planning page draws of the organ; no browser is needed to see what it is sent."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
pytest.importorskip("avatar_ros.ui.view", reason="avatar_ros is not installed")

import viser
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.view import HELD, OrganView

from avatar_core.contact.model import ContactModel, prepare, step
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.display import boundary, display_of
from avatar_core.vademecum.model import Vademecum
from tests.core.box_organ import UP, organ, top

pytestmark = pytest.mark.ros

SPHERE, DEPTH = Tip("sphere", 3e-3), 2e-3
POSE = top("cube") + np.array([3e-3, 0.0, 2e-3]) + (SPHERE.offset - DEPTH) * UP


@pytest.fixture
def view() -> Iterator[OrganView]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = viser.ViserServer("127.0.0.1", port, verbose=False)
    view = OrganView(server, lambda place: None)
    view.show(Organ.of(organ("cube")), SPHERE)
    yield view
    server.stop()


@pytest.fixture(scope="module")
def pressed() -> ContactModel:
    model = prepare(organ("cube"), (SPHERE,), effects=())
    for height in np.linspace(DEPTH, 0.0, 9):
        step(model, (POSE + height * UP)[None])
    return model


def n_faces(view: OrganView) -> int:
    return sum(len(mesh.faces) for mesh in view._bands if len(mesh.faces) > 1)


def test_under_a_tip_that_presses_the_page_draws_its_dent(
    view: OrganView, pressed: ContactModel
) -> None:
    """Deeper than any point of the cloud; and the coarse organ again, when the tip lets go."""
    cloud, force = pressed.out.cloud, pressed.out.force[0]
    sizes = np.linalg.norm(cloud[:, 3:], axis=1)
    assert view.move(cloud, POSE, force) > 0.8 * DEPTH > 1.5 * sizes.max()
    fine = n_faces(view)
    assert view.move(cloud, POSE, 0.0 * force) == pytest.approx(sizes.max())
    assert fine > 1.5 * n_faces(view)


def test_under_a_patch_the_page_draws_the_cloud(view: OrganView, pressed: ContactModel) -> None:
    view.change_tip(Tip("patch", 3e-3))
    largest = view.move(pressed.out.cloud, POSE, pressed.out.force[0])
    assert largest == pytest.approx(np.linalg.norm(pressed.out.cloud[:, 3:], axis=1).max())


def with_lesion() -> Vademecum:
    cube = organ("cube")
    corners = 6e-3 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1]], float)
    faces = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    lesion = (top("cube") - 14e-3 * UP + corners, faces)
    return replace(cube, display=display_of(cube.mesh, boundary(cube.mesh), [("lesion", lesion)]))


def test_a_structure_belongs_to_its_organ_and_moves_with_it(view: OrganView) -> None:
    sick = with_lesion()
    view.show(Organ.of(sick), SPHERE)
    (shown,) = view._structures
    before = np.array(shown.vertices)
    np.testing.assert_allclose(before, sick.surface_vertices[-4:], atol=1e-9)
    model = prepare(sick, (SPHERE,), effects=())
    for height in np.linspace(DEPTH, 0.0, 9):
        step(model, (POSE + height * UP)[None])
    view.move(model.out.cloud, POSE, model.out.force[0])
    np.testing.assert_array_equal(shown.vertices, model.out.cloud[-4:, :3])
    assert np.abs(np.array(shown.vertices) - before).max() > 0.05 * DEPTH
    view.show(Organ.of(organ("cube")), SPHERE)
    assert view._structures == []


def test_a_held_shape_is_grey_until_it_is_that_of_now(view: OrganView) -> None:
    colours = [mesh.color for mesh in view._bands]
    view.grey(True)
    assert {tuple(mesh.color) for mesh in view._bands} == {HELD}
    view.grey(False)
    assert [mesh.color for mesh in view._bands] == colours


def test_each_band_is_sent_its_own_vertices_alone(view: OrganView, pressed: ContactModel) -> None:
    """All of them, ten times over, would be 70 MB/s for 20,000 vertices."""
    cloud = pressed.out.cloud
    view.move(cloud, POSE, 0.0 * pressed.out.force[0])
    sent = sum(len(mesh.vertices) for mesh in view._bands)
    assert len(cloud) <= sent < 2.0 * len(cloud) + len(view._bands)
    filled = [mesh for mesh in view._bands if np.any(mesh.faces)]  # not the face 0, 0, 0 alone
    shown = np.concatenate([np.array(m.vertices)[m.faces] for m in filled]).mean(axis=1)
    exact = cloud[organ("cube").surface_faces, :3].mean(axis=1)
    np.testing.assert_allclose(np.sort(shown, axis=0), np.sort(exact, axis=0), atol=1e-6)
