"""Drawings of organ and tools on the planning page, as sent to the browser."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from viser import ViserServer

from avatar_core.contact.model import ContactData
from avatar_core.fem.supports import Support
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.display import boundary, display_of
from avatar_core.vademecum.model import Vademecum
from avatar_ros.ui.view import tone
from avatar_ros.ui.view.colours import HELD, N_BANDS, N_SHADES, TISSUE
from avatar_ros.ui.view.cut_handle import CutHandle
from avatar_ros.ui.view.legend import DISPLACEMENT, legend
from avatar_ros.ui.view.organ import Organ
from avatar_ros.ui.view.patterns import GAP, HATCH_GAP
from avatar_ros.ui.view.surface_view import N_TONES
from avatar_ros.ui.view.tip_body import tip_body, turn_to
from avatar_ros.ui.view.tool_view import ToolView
from avatar_ros.ui.view.view import CUT, GLASS, HIDDEN, WHOLE, OrganView
from tests.helpers.box_organ import UP, organ, top
from tests.helpers.contact import prepare, step
from tests.helpers.shown_dent import finer
from tests.ros.helpers.page import NAMES, PLACES, Noted, face_area

SPHERE, DEPTH = Tip("sphere", 3e-3), 2e-3
POSE = top("cube") + np.array([3e-3, 0.0, 2e-3]) + (SPHERE.offset - DEPTH) * UP
BODIES = [
    Tip("sphere", 5e-3),
    Tip("flat", 3e-3),
    Tip("cone", 4e-3, 60.0),
    Tip("rounded_cone", 4e-3, 30.0, 1.5e-3),
    Tip("patch", 5e-3),
]


@pytest.fixture
def view(server: ViserServer, cube: Organ) -> OrganView:
    view = OrganView(server, lambda tool, place, along_shaft: None)
    view.show(cube, (SPHERE,))
    return view


def pressing(vademecum: Vademecum) -> ContactData:
    data = prepare(vademecum, (SPHERE,), effects=())
    for height in np.linspace(DEPTH, 0.0, 9):
        step(data, (POSE + height * UP)[None])
    return data


@pytest.fixture(scope="module")
def pressed() -> ContactData:
    return pressing(organ("cube"))


def meshes(view: OrganView, group: str) -> list[Any]:
    """Return the meshes of a group that are not empty; empty ones have only face 0, 0, 0."""
    nodes = view._surface._nodes.items()
    return [mesh for (name, _), mesh in nodes if name == group and np.any(mesh.faces)]


def area(found: list[Any]) -> float:
    return sum(face_area(np.array(mesh.vertices), np.array(mesh.faces)) for mesh in found)


# --- The organ --------------------------------------------------------------------------------


def test_under_a_tip_that_presses_the_page_draws_the_dent_of_the_cloud(view: OrganView) -> None:
    fine = finer(organ("cube"))
    view.show(Organ.of(fine), (SPHERE,))
    cloud = pressing(fine).out.cloud
    largest = view.move(cloud)
    assert largest == pytest.approx(np.linalg.norm(cloud[:, 3:], axis=1).max())
    assert DEPTH > largest > 0.7 * DEPTH
    assert len(meshes(view, "bands")) > 0.7 * N_BANDS * largest / view.top
    assert view.move(0.5 * cloud) == pytest.approx(0.5 * largest)


def test_at_rest_the_organ_is_tissue_whole_and_once(view: OrganView, cube: Organ) -> None:
    """It is cut into shades, and nothing lies over it."""
    assert meshes(view, "bands") == []
    exact = face_area(cube.vertices, cube.faces)
    assert area(meshes(view, "tissue")) == pytest.approx(exact, rel=0.05)


def test_bands_and_tissue_together_cover_the_organ(view: OrganView, pressed: ContactData) -> None:
    cloud = pressed.out.cloud.copy()
    cloud[:, 3:] *= 0.05 * view.top / np.linalg.norm(cloud[:, 3:], axis=1).max() * 4.0
    cloud[:, :3] = organ("cube").surface_vertices + cloud[:, 3:]
    before = area(meshes(view, "tissue"))
    view.move(cloud)
    groups = [meshes(view, group) for group in ("tissue", "rim", "bands")]
    assert all(groups)
    assert sum(map(area, groups)) == pytest.approx(before, rel=5e-3)


def test_the_same_cloud_is_not_sent_twice(view: OrganView, pressed: ContactData) -> None:
    """A tool at rest would cost the browser thirty pictures a second."""
    largest = view.move(pressed.out.cloud)
    (first, *_) = meshes(view, "bands")
    first.vertices = np.zeros_like(first.vertices)
    assert view.move(pressed.out.cloud.copy()) == largest
    assert not np.any(first.vertices)
    for held in (True, False):  # no number stands beside a shape that is not the present one
        view.grey(held)
        assert view._marker.visible != held


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


def test_a_hidden_organ_is_neither_seen_nor_clicked(view: OrganView, server: ViserServer) -> None:
    view.look(HIDDEN)
    assert not server.scene._handle_from_node_name["/organ/surface"].visible
    drawn = {mesh.name for group in ("tissue", "bands", "rim") for mesh in meshes(view, group)}
    drawn |= {view._marker.name, view._place.name}
    assert all(name.startswith("/organ/surface/") for name in drawn)
    assert len(view.faces) == 0
    view.set_aside(True)
    view.set_aside(False)  # after a preview
    assert not server.scene._handle_from_node_name["/organ/surface"].visible
    view.look(WHOLE)
    assert len(view.faces) > 0


def test_a_click_on_a_tool_is_none_on_the_organ_behind_it(view: OrganView, cube: Organ) -> None:
    """A press on a tool that is not dragged is a click for a browser."""
    height = 0.05
    tip, eye = cube.above(height), cube.above(0.5)
    view.show_tools((SPHERE,), tip[None])
    across = np.cross(UP, np.eye(3)[2])

    def clicked(aside: float) -> bool:
        """Return whether the organ was clicked, by a ray along the surface's normal."""
        return view.clicked(eye + aside * across, -UP) is not None

    radius = SPHERE.radius
    assert [clicked(k * radius) for k in (0.0, 0.9, 1.1, 3.0)] == [False, False, True, True]
    slanting = across + 1.5 * UP
    by_shaft = tip + 0.05 * UP + 0.2 * slanting, -slanting
    assert view.clicked(*by_shaft) is None
    view.show_tools((SPHERE,), cube.above(-0.5)[None])  # behind the organ
    assert clicked(0.0) and view.clicked(*by_shaft) is not None


def shades(view: OrganView, first: int) -> list[Any]:
    """Return non-empty meshes of tissue beyond the shades, from one of them on."""
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


def test_the_clamp_has_checks_and_access_has_stripes(view: OrganView, cube: Organ) -> None:
    """Both kinds of checks together are the clamp; stripes lie where tools reach, on request."""
    whole = area(meshes(view, "tissue"))
    clamp = face_area(cube.vertices, cube.faces[cube.clamped])
    dark, light = shades(view, 0)
    assert area([dark, light]) == pytest.approx(clamp, rel=0.05)
    assert 0.4 < area([dark]) / clamp < 0.6
    view.mark_reach(True)
    *_, reached = shades(view, 0)
    reach = face_area(cube.vertices, cube.faces[cube.accessible])
    assert area([reached]) == pytest.approx(reach / GAP, rel=0.2)
    assert area(meshes(view, "tissue")) == pytest.approx(whole, rel=1e-6)
    view.mark_reach(False)
    assert len(shades(view, 0)) == 2


def test_what_springs_hold_is_hatched(view: OrganView) -> None:
    """Nothing else changes; the legend names springs only then."""
    cube = organ("cube")
    held = np.zeros(len(cube.regions.clamped), bool)
    held[np.flatnonzero(~cube.regions.clamped & ~cube.regions.accessible)[:60]] = True
    shown = Organ.of(replace(cube, supports=(Support("bare_area", held, 1e6),)))
    np.testing.assert_array_equal(shown.sprung, held)
    whole = area(meshes(view, "tissue"))
    view.show(shown, (SPHERE,))
    there = face_area(shown.vertices, shown.faces[held])
    _, _, hatching = shades(view, 0)
    assert area([hatching]) == pytest.approx(there / HATCH_GAP, rel=0.2)
    assert area(meshes(view, "tissue")) == pytest.approx(whole, rel=1e-6)
    assert "springs" in legend(DISPLACEMENT, 1.0, has_springs=True)
    assert "springs" not in legend(DISPLACEMENT, 1.0)


def test_the_legend_says_where_colours_of_glass_hold() -> None:
    assert "only on the plain background" in legend(DISPLACEMENT, 1.0, opacity=0.45)
    assert "plain background" not in legend(DISPLACEMENT, 1.0)


def test_little_error_looks_unlike_no_access(view: OrganView, cube: Organ) -> None:
    """A face with an error is in a band, the first one too; a face without stays tissue."""
    errors = np.full(len(cube.vertices), np.nan)
    reached = cube.faces[cube.accessible]
    errors[np.unique(reached)] = 0.5e-3  # half a band of a scale to 2 %
    is_known = np.isfinite(errors)[cube.faces].all(axis=1)
    view.paint(errors)
    (first,) = meshes(view, "bands")
    assert first is view._surface._nodes["bands", 0]
    known = face_area(cube.vertices, cube.faces[is_known])
    assert area([first]) == pytest.approx(known, rel=0.05)
    assert tuple(first.color) != tuple(tone.material(np.array(TISSUE)))


def with_lesion() -> Vademecum:
    cube = organ("cube")
    corners = 6e-3 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1]], float)
    faces = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    lesion = (top("cube") - 14e-3 * UP + corners, faces)
    return replace(cube, display=display_of(cube.mesh, boundary(cube.mesh), [("lesion", lesion)]))


def test_a_structure_belongs_to_its_organ_and_moves_with_it(view: OrganView, cube: Organ) -> None:
    sick = with_lesion()
    view.show(Organ.of(sick), (SPHERE,))
    parts = view._structures._parts
    before = [np.array(part.mesh.vertices) for part in parts]
    assert sum(len(part.mesh.faces) for part in parts) == 4
    data = pressing(sick)
    view.move(data.out.cloud)
    for part, old in zip(parts, before, strict=True):
        np.testing.assert_array_equal(part.mesh.vertices, data.out.cloud[part.used, :3])
        assert np.abs(np.array(part.mesh.vertices) - old).max() > 0.05 * DEPTH
    view.show(cube, (SPHERE,))
    assert view._structures._parts == []


def test_the_walls_of_a_cut_are_drawn_as_flesh(view: OrganView, cube: Organ) -> None:
    view.show(replace(cube, walls=cube.faces[:6]), (SPHERE,))
    parts = view._structures._parts
    assert sum(len(part.mesh.faces) for part in parts) == 6
    red, green, blue = np.mean([part.mesh.color for part in parts], axis=0)
    assert red > 2.0 * max(green, blue) and blue > 0.8 * green  # unlike a lesion's orange
    view.show(cube, (SPHERE,))
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
def test_a_tool_is_lifted_off_the_organ_however_deep_it_is(cube: Organ, depth: float) -> None:
    """A cube of 200 mm, whose top is accessible."""
    lifted = cube.lifted(top("cube") - depth * UP, 0.03)
    np.testing.assert_allclose(lifted, top("cube") + (0.03 + max(0.0, -depth)) * UP, atol=1e-6)


def test_the_scale_never_shrinks_during_a_touch_and_begins_anew_at_rest(view: OrganView) -> None:
    rest = np.zeros((len(view.points), 6))
    rest[:, :3] = view.points
    tops = []
    for largest in (7e-3, 1e-3, 0.0, 1e-3):
        cloud = rest.copy()
        cloud[0, 3:] = 0.0, 0.0, largest
        view.move(cloud)
        tops.append(view.top)
    assert tops == [1e-2, 1e-2, 1e-3, 1e-3]


def test_the_plane_of_a_cut_follows_its_handle(server: ViserServer, cube: Organ) -> None:
    parts: list[float] = []
    handle = CutHandle(server, parts.append)
    up = np.array([0.0, 1.0, 0.0])
    plane = handle.show(cube, up, 0.25)
    top, bottom = cube.vertices[:, 1].max(), cube.vertices[:, 1].min()
    assert plane.point @ up == pytest.approx(top - 0.25 * (top - bottom), abs=1e-6)
    assert handle._part() == pytest.approx(0.25, abs=1e-6)
    node = handle._handle
    node.position = tuple(np.array(node.position) - 0.25 * (top - bottom) * up)
    handle._moved()
    assert parts[-1] == pytest.approx(0.5, abs=1e-6)
    handle.show(cube, up, 0.5)
    assert handle._handle is node  # a held handle is not made anew
    handle.show(cube, np.array([1.0, 0.0, 0.0]), 0.5)
    assert handle._handle is not node
    handle.hide()


# --- Tools ------------------------------------------------------------------------------------


def test_all_tools_are_drawn_with_their_names_and_forces(server: ViserServer, cube: Organ) -> None:
    user = Noted()
    view = OrganView(server, user.drag)
    view.show(cube, (Tip(), Tip("flat", 2e-3)))
    starts = cube.starts((Tip(), Tip("flat", 2e-3)))
    np.testing.assert_allclose([tool.position for tool in view._tools], starts, atol=1e-6)
    view.name_tools(NAMES, 1)
    view.place_tools(PLACES, np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 0.0]]), [False, False])
    left, right = view._tools
    assert (left._text.text, right._text.text) == ("left 2.0 N", "[right]")
    assert left._arrow.visible and not right._arrow.visible
    view.show_tools((Tip(),), PLACES[:1])
    view.name_tools(("",), 0)
    view.place_tools(PLACES[:1], np.zeros((1, 3)), [False])
    assert len(view._tools) == 1 and not view._tools[0]._text.visible


def test_a_browser_that_draws_late_drags_no_farther_than_the_mouse_went(
    server: ViserServer, cube: Organ
) -> None:
    """It reports the tool where it drew it last: still at the drag's begin."""
    user = Noted()
    tool = ToolView(server, 1, user.drag)
    tool.show(Tip(), PLACES[1], np.array([1.0, 0.0, 0.0, 0.0]))
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    for phase, way in (("start", 0.0), ("update", 0.01), ("update", 0.02), ("end", 0.02)):
        event: Any = SimpleNamespace(
            phase=phase, start_position=(0.0, 0.0, 0.0), end_position=(way, 0.0, 0.0)
        )
        tool._dragged(event, False)
        _, number, begin, gone, along_shaft = user.calls[-1]
        tool.place(begin + gone, upright, np.zeros(3))
        np.testing.assert_allclose(tool.position, PLACES[1] + [way, 0.0, 0.0], atol=1e-9)
        assert (number, along_shaft) == (1, False)


@pytest.mark.parametrize("tip", BODIES, ids=lambda tip: tip.shape)
def test_a_body_is_as_wide_and_as_deep_as_its_tip(tip: Tip) -> None:
    vertices, faces = tip_body(tip)
    assert vertices[:, 2].min() == pytest.approx(-tip.offset)
    assert np.hypot(*vertices.T[:2]).max() == pytest.approx(tip.radius, rel=3e-3)
    assert faces.min() == 0 and faces.max() == len(vertices) - 1


@pytest.mark.parametrize("tip", BODIES, ids=lambda tip: tip.shape)
def test_the_faces_of_a_body_look_outwards(tip: Tip) -> None:
    """Their volume is that of the tip under its shaft."""
    vertices, faces = tip_body(tip)
    a, b, c = vertices[faces].swapaxes(0, 1)
    volume = np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0
    r = np.linspace(0.0, tip.radius, 2000)
    if tip.shape in ("sphere", "patch"):
        expected = 4.0 / 3.0 * np.pi * tip.radius**3
    else:
        height = tip.height(r)
        top = height[-1] + 2.0 * tip.radius
        expected = 2.0 * np.pi * np.trapezoid((top - height) * r, r)
    assert volume == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("direction", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, 0, -0.8), (0, 1, 0)])
def test_the_shaft_turns_to_the_normal(direction: tuple[float, float, float]) -> None:
    w, *v = turn_to(np.array(direction, float))
    z = np.array([0.0, 0.0, 1.0])
    turned = z + 2.0 * np.cross(v, np.cross(v, z) + w * z)
    np.testing.assert_allclose(turned, direction, atol=1e-12)
