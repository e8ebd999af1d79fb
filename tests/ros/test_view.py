"""What the planning page draws of the organ; no browser is needed to see what it is sent."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
pytest.importorskip("avatar_ros.ui.view", reason="avatar_ros is not installed")

import viser
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.view import OrganView

from avatar_core.contact.model import ContactModel, prepare, step
from avatar_core.geometry.tip import Tip
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
    view.show(Organ.of(organ("cube")), None, SPHERE)
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
