"""What the planning page draws of the organ; no browser is needed to see what it is sent."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
pytest.importorskip("avatar_ros.ui.view", reason="avatar_ros is not installed")

import viser
from avatar_ros.ui import tone
from avatar_ros.ui.colours import HELD, N_BANDS, N_SHADES, TISSUE
from avatar_ros.ui.legend import legend
from avatar_ros.ui.organ import Organ
from avatar_ros.ui.patterns import GAP, HATCH_GAP
from avatar_ros.ui.surface_view import N_TONES
from avatar_ros.ui.view import CUT, GLASS, WHOLE, OrganView

from avatar_core.contact.model import ContactModel, prepare, step
from avatar_core.fem.supports import Support
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.display import boundary, display_of
from avatar_core.vademecum.model import Vademecum
from tests.helpers.box_organ import UP, organ, top

pytestmark = pytest.mark.ros

SPHERE, DEPTH = Tip("sphere", 3e-3), 2e-3
POSE = top("cube") + np.array([3e-3, 0.0, 2e-3]) + (SPHERE.offset - DEPTH) * UP


@pytest.fixture
def view() -> Iterator[OrganView]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = viser.ViserServer("127.0.0.1", port, verbose=False)
    view = OrganView(server, lambda tool, place, along_shaft: None)
    view.show(Organ.of(organ("cube")), (SPHERE,))
    yield view
    server.stop()


@pytest.fixture(scope="module")
def pressed() -> ContactModel:
    model = prepare(organ("cube"), (SPHERE,), effects=())
    for height in np.linspace(DEPTH, 0.0, 9):
        step(model, (POSE + height * UP)[None])
    return model


def meshes(view: OrganView, group: str) -> list[Any]:
    """Those of a group that are not empty, which are the face 0, 0, 0 alone."""
    nodes = view._surface._nodes.items()
    return [mesh for (name, _), mesh in nodes if name == group and np.any(mesh.faces)]


def area(found: list[Any]) -> float:
    corners = [np.array(mesh.vertices)[np.array(mesh.faces)] for mesh in found]
    a, b, c = np.concatenate(corners).transpose(1, 0, 2).astype(float)
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def test_under_a_tip_that_presses_the_page_draws_its_dent(
    view: OrganView, pressed: ContactModel
) -> None:
    """Deeper than any point of the cloud; and none of it when the tip lets go."""
    cloud, force = pressed.out.cloud, pressed.out.force[0]
    sizes = np.linalg.norm(cloud[:, 3:], axis=1)
    assert view.move(cloud, POSE[None], force[None]) > 0.8 * DEPTH > 1.5 * sizes.max()
    assert len(meshes(view, "bands")) > 0.7 * N_BANDS * 0.8 * DEPTH / view.top
    assert view.move(0.5 * cloud, POSE[None], 0.0 * force[None]) == pytest.approx(0.5 * sizes.max())


def test_at_rest_the_organ_is_tissue_whole_and_once(view: OrganView) -> None:
    """Cut into shades, smoothed, and nothing over it."""
    assert meshes(view, "bands") == []
    cube = organ("cube")
    corners = cube.surface_vertices[cube.organ_faces].astype(float)
    a, b, c = corners.transpose(1, 0, 2)
    exact = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert area(meshes(view, "tissue")) == pytest.approx(exact, rel=0.05)


def test_bands_and_tissue_together_cover_the_organ(view: OrganView, pressed: ContactModel) -> None:
    cloud = pressed.out.cloud.copy()
    cloud[:, 3:] *= 0.05 * view.top / np.linalg.norm(cloud[:, 3:], axis=1).max() * 4.0
    cloud[:, :3] = organ("cube").surface_vertices + cloud[:, 3:]
    before = area(meshes(view, "tissue"))
    view.move(cloud, POSE[None], np.zeros((1, 3)))
    groups = [meshes(view, group) for group in ("tissue", "rim", "bands")]
    assert all(groups)
    assert sum(map(area, groups)) == pytest.approx(before, rel=5e-3)


def test_the_same_cloud_is_not_sent_twice(view: OrganView, pressed: ContactModel) -> None:
    """A tool at rest would cost the browser thirty pictures a second."""
    cloud, force = pressed.out.cloud, pressed.out.force[0]
    largest = view.move(cloud, POSE[None], force[None])
    (first, *_) = meshes(view, "bands")
    first.vertices = np.zeros_like(first.vertices)
    assert view.move(cloud.copy(), POSE[None], force[None]) == largest
    assert not np.any(first.vertices)


def test_cut_open_shows_half_and_the_far_wall(view: OrganView) -> None:
    whole = area(meshes(view, "tissue"))
    view.look(CUT, "A", 0.5)
    assert area(meshes(view, "tissue")) < 0.75 * whole
    assert len(meshes(view, "inside")) == 1
    view.look(GLASS)
    assert meshes(view, "inside") == []
    assert area(meshes(view, "tissue")) == pytest.approx(whole)
    assert {mesh.opacity for mesh in meshes(view, "tissue")} == {view.opacity} != {1.0}
    view.look(WHOLE)
    assert view.opacity == 1.0 and len(meshes(view, "inside")) == 1  # behind cracks


def shades(view: OrganView, first: int) -> list[Any]:
    """Meshes of tissue that are no shades, from one beyond these on, and not empty."""
    nodes = view._surface._nodes
    beyond = [nodes["tissue", k] for k in range(N_SHADES + first, N_TONES)]
    return [mesh for mesh in beyond if np.any(mesh.faces)]


def test_what_is_cut_away_is_not_clicked(view: OrganView) -> None:
    whole = view.faces
    view.look(CUT, "A", 0.5)
    kept = view.faces
    assert 0.2 * len(whole) < len(kept) < 0.8 * len(whole)
    front = view.points[whole].mean(axis=1)[:, 1].max()
    assert view.points[kept].mean(axis=1)[:, 1].max() < 0.6 * front
    view.look(WHOLE)
    assert len(view.faces) == len(whole)


def test_the_clamp_has_checks_and_access_has_stripes(view: OrganView) -> None:
    """Both kinds of checks together are the clamp; stripes lie where tools reach, if asked for."""
    shown = Organ.of(organ("cube"))
    whole = area(meshes(view, "tissue"))
    corners = shown.vertices[shown.faces[shown.clamped]].astype(float)
    a, b, c = corners.transpose(1, 0, 2)
    clamp = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    dark, light = shades(view, 0)
    assert area([dark, light]) == pytest.approx(clamp, rel=0.05)
    assert 0.4 < area([dark]) / clamp < 0.6
    view.mark_reach(True)
    *_, reached = shades(view, 0)
    corners = shown.vertices[shown.faces[shown.accessible]].astype(float)
    a, b, c = corners.transpose(1, 0, 2)
    reach = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert area([reached]) == pytest.approx(reach / GAP, rel=0.2)
    assert area(meshes(view, "tissue")) == pytest.approx(whole, rel=1e-6)
    view.mark_reach(False)
    assert len(shades(view, 0)) == 2


def test_what_springs_hold_is_hatched(view: OrganView) -> None:
    """And nothing else changes; the legend names it then alone."""
    cube = organ("cube")
    held = np.zeros(len(cube.regions.clamped), bool)
    held[np.flatnonzero(~cube.regions.clamped & ~cube.regions.accessible)[:60]] = True
    shown = Organ.of(replace(cube, supports=(Support("bare_area", held, 1e6),)))
    np.testing.assert_array_equal(shown.sprung, held)
    whole = area(meshes(view, "tissue"))
    view.show(shown, (SPHERE,))
    corners = shown.vertices[shown.faces[held]].astype(float)
    a, b, c = corners.transpose(1, 0, 2)
    there = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    _, _, hatching = shades(view, 0)
    assert area([hatching]) == pytest.approx(there / HATCH_GAP, rel=0.2)
    assert area(meshes(view, "tissue")) == pytest.approx(whole, rel=1e-6)
    assert "springs" in legend(1e-3, has_springs=True) and "springs" not in legend(1e-3)


def test_little_error_looks_unlike_no_access(view: OrganView) -> None:
    """A face with an error is in a band, the first one too; one without stays tissue."""
    shown = Organ.of(organ("cube"))
    errors = np.full(len(shown.vertices), np.nan)
    reached = shown.faces[shown.accessible]
    errors[np.unique(reached)] = 0.5e-3  # half a band of a scale to 2 %
    is_known = np.isfinite(errors)[shown.faces].all(axis=1)
    view.paint(errors)
    (first,) = meshes(view, "bands")
    assert first is view._surface._nodes["bands", 0]
    corners = shown.vertices[shown.faces[is_known]].astype(float)
    a, b, c = corners.transpose(1, 0, 2)
    known = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    assert area([first]) == pytest.approx(known, rel=0.05)
    assert tuple(first.color) != tuple(tone.material(np.array(TISSUE)))


def test_under_a_patch_the_page_draws_the_cloud(view: OrganView, pressed: ContactModel) -> None:
    view.change_tips((Tip("patch", 3e-3),))
    largest = view.move(pressed.out.cloud, POSE[None], pressed.out.force)
    assert largest == pytest.approx(np.linalg.norm(pressed.out.cloud[:, 3:], axis=1).max())


def with_lesion() -> Vademecum:
    cube = organ("cube")
    corners = 6e-3 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1]], float)
    faces = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    lesion = (top("cube") - 14e-3 * UP + corners, faces)
    return replace(cube, display=display_of(cube.mesh, boundary(cube.mesh), [("lesion", lesion)]))


def test_a_structure_belongs_to_its_organ_and_moves_with_it(view: OrganView) -> None:
    sick = with_lesion()
    view.show(Organ.of(sick), (SPHERE,))
    parts = view._structures._parts
    before = [np.array(part.mesh.vertices) for part in parts]
    assert sum(len(part.mesh.faces) for part in parts) == 4
    model = prepare(sick, (SPHERE,), effects=())
    for height in np.linspace(DEPTH, 0.0, 9):
        step(model, (POSE + height * UP)[None])
    view.move(model.out.cloud, POSE[None], model.out.force)
    for part, old in zip(parts, before, strict=True):
        np.testing.assert_array_equal(part.mesh.vertices, model.out.cloud[part.used, :3])
        assert np.abs(np.array(part.mesh.vertices) - old).max() > 0.05 * DEPTH
    view.show(Organ.of(organ("cube")), (SPHERE,))
    assert view._structures._parts == []


def test_a_held_shape_is_grey_until_it_is_that_of_now(view: OrganView) -> None:
    bands = [view._surface._nodes["bands", k] for k in range(N_BANDS)]
    colours = [tuple(mesh.color) for mesh in bands]
    view.grey(True)
    assert {tuple(mesh.color) for mesh in bands} == {tuple(tone.material(np.array(HELD)))}
    view.look(GLASS, "A", 0.5)  # made anew
    bands = [view._surface._nodes["bands", k] for k in range(N_BANDS)]
    assert {tuple(mesh.color) for mesh in bands} == {tuple(tone.material(np.array(HELD)))}
    for group in ("tissue", "rim"):  # at rest too
        for k in range(N_SHADES):
            red, green, blue = view._surface._nodes[group, k].color
            assert red == green == blue
    view.grey(False)
    assert [tuple(mesh.color) for mesh in bands] == colours
    red, green, _ = view._surface._nodes["tissue", 0].color
    assert red > green


@pytest.mark.parametrize("depth", [-5e-3, 4e-3, 25e-3])
def test_a_tool_is_lifted_off_the_organ_however_deep_it_is(depth: float) -> None:
    """Of a cube of 200 mm, whose top is accessible."""
    shown = Organ.of(organ("cube"))
    lifted = shown.lifted(top("cube") - depth * UP, 0.03)
    np.testing.assert_allclose(lifted, top("cube") + (0.03 + max(0.0, -depth)) * UP, atol=1e-6)


def test_the_scale_never_shrinks_during_a_touch_and_begins_anew_at_rest(view: OrganView) -> None:
    rest = np.zeros((len(view.points), 6))
    rest[:, :3] = view.points
    tops = []
    for largest in (7e-3, 1e-3, 0.0, 1e-3):
        cloud = rest.copy()
        cloud[0, 3:] = 0.0, 0.0, largest
        view.move(cloud, np.ones((1, 3)), np.zeros((1, 3)))
        tops.append(view.top)
    assert tops == [1e-2, 1e-2, 1e-3, 1e-3]
