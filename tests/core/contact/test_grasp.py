"""A jaw that closes, pulls and lets go: its law, its energy, and its effect on other tools."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar_core.contact.effects import (
    Effect,
    Grasp,
    Inertia,
    LargeDeformation,
    SelfWeight,
    SeveralTools,
    Viscoelasticity,
)
from avatar_core.contact.effects.grasp import FARTHEST, REACH
from avatar_core.contact.model import FAR_AWAY, ContactData, Status, model_of, step
from avatar_core.contact.tool_path import middle_of_access
from avatar_core.errors import SceneError
from avatar_core.geometry.tip import Jaw, Tip
from avatar_core.vademecum.model import Vademecum
from tests.helpers.coarse_liver import RADIUS, Spot, liver, spots

OPEN, SHUT = np.array([False]), np.array([True])
ABOVE = 0.5e-3  # height of a jaw that closes over the surface [m]


def jaw_of(slip: float = 100.0, radius: float = 3e-3) -> Tip:
    return Tip("sphere", RADIUS, grasp=Jaw(radius, slip))


def holding(
    spot: Spot, tip: Tip | None = None, effects: tuple[Effect, ...] = (Grasp(),)
) -> tuple[ContactData, np.ndarray]:
    """Close a tool's jaw over a spot; return the data and the tool's place, shape (1, 3) [m]."""
    data = model_of(liver(), (tip or jaw_of(),), effects=effects).data()
    at = spot.tip(-ABOVE)[None]
    step(data.model, data, at, None, OPEN)
    step(data.model, data, at, None, SHUT)
    return data, at


def middle() -> Spot:
    return spots()[len(spots()) // 2]


def test_a_jaw_that_closes_pulls_nothing_and_then_like_a_spring() -> None:
    data, at = holding(middle())
    assert data.holds(0) and not data.out.force.any() and data.out.n_contacts[0] == 1
    pull = np.array([[1e-3, -0.5e-3, 1.5e-3]])
    forces = []
    for part in (1.0, 2.0, -1.0):
        step(data.model, data, at + part * pull)
        forces.append(data.out.force[0].copy())
    np.testing.assert_allclose(forces[1], 2.0 * forces[0], rtol=1e-9)
    np.testing.assert_allclose(forces[2], -forces[0], rtol=1e-9)
    assert forces[0] @ pull[0] < 0.0  # back to where it was taken


def test_a_jaw_that_closes_while_it_presses_lets_the_pressure_go() -> None:
    """If it went on, a disc stiffer than the tip would return more energy than was put in."""
    data = model_of(liver(), (jaw_of(),), effects=(Grasp(),)).data()
    for depth in (-1e-3, 1e-3, 3e-3):
        step(data.model, data, middle().tip(depth)[None], None, OPEN)
    assert np.linalg.norm(data.out.force[0]) > 0.3
    step(data.model, data, middle().tip(3e-3)[None], None, SHUT)
    assert data.holds(0) and np.linalg.norm(data.out.force[0]) < 1e-9


def test_the_stiffness_is_that_of_the_organ_and_of_a_bonded_disc() -> None:
    """1 / (2 E* a) along the normal, (2 - nu) / (8 G a) along the surface, in series with C - c."""
    v, spot = liver(), middle()
    young, nu = v.material.young_modulus, v.material.poisson_ratio
    shear = young / (2.0 * (1.0 + nu))
    inverse = []
    for radius in (2e-3, 4e-3):
        data, _ = holding(spot, jaw_of(radius=radius))
        inverse.append(np.linalg.inv(data.state.grasp.stiffness[0]))
    n = data.state.normal[0]
    # the tip's curvature correction; a disc is as large on a curved surface
    assert abs(data.state.law.shape[0]) > 1e-3
    less = (inverse[0] - inverse[1]) / (1.0 / 2e-3 - 1.0 / 4e-3)
    t = np.cross(n, np.eye(3)[np.argmin(abs(n))])
    t /= np.linalg.norm(t)
    assert n @ less @ n == pytest.approx((1.0 - nu**2) / (2.0 * young), rel=1e-6)
    assert t @ less @ t == pytest.approx((2.0 - nu) / (8.0 * shear), rel=1e-6)


def gained_on_a_loop(data: ContactData, start: np.ndarray, size: float) -> float:
    """Work that a closed path returns, over the work done along it."""
    turn = np.linspace(0.0, 2.0 * np.pi, 400)
    way = np.stack([np.sin(turn), np.sin(2.0 * turn), 1.0 - np.cos(3.0 * turn)], axis=1)
    path, force = start + size * way, []
    for place in path:
        step(data.model, data, place[None])
        force.append(data.out.force[0].copy())
    mean = 0.5 * (np.array(force)[1:] + np.array(force)[:-1])
    work = -(mean * np.diff(path, axis=0)).sum(axis=1)
    return float(work.sum() / np.abs(work).sum())


def test_no_closed_path_gains_energy() -> None:
    data, at = holding(middle())
    assert abs(gained_on_a_loop(data, at[0], 4e-3)) < 1e-9


@pytest.fixture()
def soft(bent: Vademecum) -> Vademecum:
    """An organ of large deformation so soft that its jaw does not slip."""
    return bent.at(young=2e4)


@pytest.fixture()
def soft_hold(soft: Vademecum) -> tuple[ContactData, np.ndarray]:
    """A jaw that has closed over the soft organ, and where it is."""
    position = middle_of_access(soft)
    effects = (Grasp(), LargeDeformation())
    data = model_of(soft, (jaw_of(radius=15e-3),), effects=effects, cloud="volume").data()
    at = soft.surface.centers[[position]] + (RADIUS + ABOVE) * soft.surface.normals[position]
    step(data.model, data, at, None, OPEN)
    step(data.model, data, at, None, SHUT)
    return data, at


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["pull", "push"])
def test_a_long_pull_bends_the_organ_as_the_vademecum_says(
    soft: Vademecum, soft_hold: tuple[ContactData, np.ndarray], side: float
) -> None:
    data, at = soft_hold
    state, n = data.state, data.state.normal[0].copy()
    pull = side * 12e-3 * n
    status = [step(data.model, data, at + part * pull) for part in (0.3, 0.6, 1.0)]
    assert status == [Status.OK] * 3
    g = -data.out.force[0]
    nodes, weights = state.nodes[0, : state.n_nodes[0]], state.weight[0, : state.n_nodes[0], 0]
    m = weights @ soft.surface.normals[nodes]
    m /= np.linalg.norm(m)
    pressed = soft.push(nodes, weights, -float(g @ m))
    bent_depth = pressed.depth - replace(soft, large=None).push(nodes, weights, -float(g @ m)).depth
    assert abs(bent_depth) > 0.2e-3
    # the law: (C + disc) g = y + n k h
    left = np.linalg.solve(state.grasp.stiffness[0], g) - pull
    kept = state.large_deformation.kept[0]
    assert left @ n == pytest.approx(kept * bent_depth, rel=0.05)
    assert np.linalg.norm(left - (left @ n) * n) < 1e-6
    want = pressed.displacement + soft.displacement(nodes, weights) @ (g - (g @ m) * m)
    far = np.linalg.norm(soft.mesh.vertices - state.point[0], axis=1) > 50e-3
    shown, want = data.out.cloud[far, 3:], want.reshape(-1, 3)[far]
    assert np.abs(shown - want).max() < 0.02 * np.abs(want).max()


def test_no_closed_path_gains_energy_at_large_deformation(
    soft_hold: tuple[ContactData, np.ndarray],
) -> None:
    data, at = soft_hold
    assert abs(gained_on_a_loop(data, at[0], 10e-3)) < 1e-5  # the trapezoidal rule's


def test_a_large_pull_beyond_its_reach_is_said(soft_hold: tuple[ContactData, np.ndarray]) -> None:
    data, at = soft_hold
    n = data.state.normal[0].copy()
    reach = float(data.state.large_deformation.pulled[0, 2])
    near = 12e-3 * n
    assert step(data.model, data, at + near) == Status.OK
    depth = data.state.self_compliance[0] * float(data.out.force[0] @ n)
    far = 1.1 * reach / abs(depth) * near
    assert step(data.model, data, at + far) == Status.EXTRAPOLATED
    data.state.large_deformation.pulled[0, 2] = 1.0
    assert step(data.model, data, at + far) == Status.OK  # the jaw's own disc is still in its range
    aside = np.cross(n, np.eye(3)[np.argmin(abs(n))])
    aside *= 1.2 * FARTHEST / np.linalg.norm(aside)
    assert step(data.model, data, at + aside) == Status.EXTRAPOLATED


def test_two_graspers_feel_each_other_alike() -> None:
    """Maxwell: a pull of one tool acts on the other as the other's on it."""
    one, other = (
        spots()[3],
        min(spots(), key=lambda spot: abs(np.linalg.norm(spot.center - spots()[3].center) - 25e-3)),
    )
    effects = (Grasp(), SeveralTools())
    data = model_of(liver(), (jaw_of(), jaw_of()), effects=effects).data()
    at = np.array([one.tip(-ABOVE), other.tip(-ABOVE)])
    step(data.model, data, at, None, np.array([False, False]))
    step(data.model, data, at, None, np.array([True, True]))
    across = np.zeros((2, 3, 3))
    for tool in (0, 1):
        for d in range(3):
            moved = at.copy()
            moved[tool, d] += 1e-3
            step(data.model, data, moved)
            across[tool, :, d] = data.out.force[1 - tool]
    size = np.abs(across).max()
    assert size > 1e-3
    np.testing.assert_allclose(across[0], across[1].T, atol=1e-6 * size)


def test_a_tool_beside_presses_into_tissue_that_is_held() -> None:
    """A held point beside a push yields less than a free one, and bears a force."""
    spot = spots()[3]
    other = min(spots(), key=lambda s: abs(np.linalg.norm(s.center - spot.center) - 20e-3))
    data = model_of(liver(), (jaw_of(), Tip("sphere", RADIUS)), effects=(Grasp(), SeveralTools()))
    data = data.data()
    away, there = other.tip(-5e-3), other.tip(3e-3)
    forces = []
    for shut in (False, True):
        step(data.model, data, np.array([spot.tip(-ABOVE), away]), None, np.zeros(2, bool))
        step(data.model, data, np.array([spot.tip(-ABOVE), away]), None, np.array([shut, False]))
        step(data.model, data, np.array([spot.tip(-ABOVE), there]))
        forces.append(data.out.force.copy())
    free, held = forces
    assert np.linalg.norm(held[1]) > np.linalg.norm(free[1]) > 0.0
    assert not free[0].any() and held[0].any()


@pytest.mark.parametrize("effect", [None, Viscoelasticity((0.4,), (0.3,)), Inertia()])
@pytest.mark.parametrize("there", [np.full(3, FAR_AWAY), -15e-3])
def test_a_jaw_that_is_torn_off_moves_no_other_tool(
    effect: Effect | None, there: np.ndarray | float
) -> None:
    """The other tool's force is as if the jaw had been opened in that period."""
    spot = spots()[3]
    other = min(spots(), key=lambda s: abs(np.linalg.norm(s.center - spot.center) - 20e-3))
    effects = (Grasp(), SeveralTools(), *([effect] if effect else []))
    model = model_of(liver(), (jaw_of(slip=4.0), Tip("sphere", RADIUS)), effects=effects)
    shut, at = np.array([True, False]), np.array([spot.tip(-ABOVE), other.tip(-5e-3)])
    torn = np.array([spot.tip(there) if isinstance(there, float) else there, other.tip(3e-3)])
    forces = []
    for last in (shut, ~shut):  # torn off; opened
        data = model.data()
        step(model, data, at, None, np.zeros(2, bool))
        step(model, data, at, None, shut)
        for depth in np.linspace(-5e-3, 3e-3, 20):
            step(model, data, np.array([at[0], other.tip(depth)]), None, shut)
        assert data.holds(0)
        forces.append([])
        for _ in range(30):
            step(model, data, torn, None, last)
            forces[-1].append(data.out.force[1].copy())
    assert np.linalg.norm(forces[1][0]) > 0.1
    np.testing.assert_allclose(*forces, atol=1e-3 * np.linalg.norm(forces[1][0]))


def test_it_lets_go_what_is_pulled_too_hard_until_the_jaw_opens() -> None:
    data, at = holding(middle(), jaw_of(slip=0.3))
    normal = data.state.normal[0].copy()
    for way in np.linspace(0.0, 3e-3, 30):
        status = step(data.model, data, at + way * normal)
        assert np.linalg.norm(data.out.force[0]) <= 0.3
    assert status == Status.SLIPPED and not data.holds(0)
    assert step(data.model, data, at) == Status.SLIPPED  # closed, and back over the organ
    for depth, status in ((-4e-3, Status.SLIPPED), (2e-3, Status.OK), (-4e-3, Status.SLIPPED)):
        assert step(data.model, data, at - depth * normal) == status
        assert data.out.force.any() == (status == Status.OK)
    step(data.model, data, at, None, OPEN)
    step(data.model, data, at, None, SHUT)
    assert data.holds(0)


def test_a_jaw_that_opens_at_depth_gives_nothing_back() -> None:
    data, at = holding(middle())
    normal = data.state.normal[0].copy()
    step(data.model, data, at - 4e-3 * normal)
    assert np.linalg.norm(data.out.force[0]) > 0.5
    step(data.model, data, at - 4e-3 * normal, None, OPEN)
    step(data.model, data, at - 4e-3 * normal)
    assert not data.out.force.any()
    step(data.model, data, at + 4e-3 * normal)
    step(data.model, data, at - 2e-3 * normal)  # from outside, it presses again
    assert data.out.force[0] @ normal > 0.1


def test_a_jaw_beyond_reach_or_closed_before_holds_nothing() -> None:
    data = model_of(liver(), (jaw_of(),), effects=(Grasp(),)).data()
    far = middle().tip(-REACH - 1e-3)[None]
    step(data.model, data, far, None, OPEN)
    step(data.model, data, far, None, SHUT)
    assert not data.holds(0)
    step(data.model, data, middle().tip(-ABOVE)[None])  # comes near with its jaw closed
    assert not data.holds(0) and data.out.status[0] == Status.OK


def holding_what_hangs(gravity: float) -> tuple[ContactData, np.ndarray, np.ndarray]:
    """A tool that has closed its jaw on the sagged surface, where it is, and the sag there [m]."""
    data, _ = holding(middle(), effects=(Grasp(), SelfWeight(gravity=gravity)))
    cloud = data.out.cloud
    vertex = np.argmin(np.linalg.norm(cloud[:, :3] - cloud[:, 3:] - middle().center, axis=1))
    sag = cloud[vertex, 3:].astype(float)
    data.reset()
    at = (middle().tip(-ABOVE) + sag)[None]
    for _ in range(2):
        step(data.model, data, at, None, OPEN)
    step(data.model, data, at, None, SHUT)
    assert data.holds(0)
    assert np.linalg.norm(data.out.force[0]) < 1e-9
    return data, at, sag


def test_tissue_that_hangs_is_taken_where_it_hangs() -> None:
    """Closed on the sagged surface, it takes the point that has come there, and pulls nothing."""
    data, at, sag = holding_what_hangs(9.81)
    assert np.linalg.norm(sag) > 1e-3
    taken = data.state.point[0] - middle().center
    assert np.linalg.norm(taken) < 0.3 * np.linalg.norm(sag)
    step(data.model, data, at + np.array([[0.0, 2e-3, 0.0]]))
    assert data.out.force[0, 1] < -0.1


def test_a_sag_is_no_pull_beyond_the_range() -> None:
    """Tissue that hangs by more than the range of a pull is held like tissue at rest."""
    data, at, sag = holding_what_hangs(30.0)
    assert np.linalg.norm(sag) > FARTHEST
    assert data.out.status[0] == Status.OK
    pull = 0.9 * FARTHEST * data.state.normal[0]
    assert step(data.model, data, at + pull) == Status.OK
    assert step(data.model, data, at + pull / 0.8) == Status.EXTRAPOLATED


def test_what_is_held_moves_with_the_jaw_on_the_screen() -> None:
    data, at = holding(middle(), jaw_of(radius=8e-3))
    pull = np.array([1e-3, 2e-3, 1e-3])
    step(data.model, data, at + pull)
    rest = data.out.cloud[:, :3] - data.out.cloud[:, 3:]
    vertex = np.argmin(np.linalg.norm(rest - data.state.point[0], axis=1))
    assert np.linalg.norm(rest[vertex] - data.state.point[0]) < 8e-3
    np.testing.assert_allclose(data.out.cloud[vertex, 3:], pull, atol=0.15 * 2.5e-3)


def test_a_pull_beyond_the_linear_range_is_said() -> None:
    data, at = holding(middle())
    assert step(data.model, data, at + np.array([[0.0, 0.9 * FARTHEST, 0.0]])) == Status.OK
    assert (
        step(data.model, data, at + np.array([[0.0, 1.1 * FARTHEST, 0.0]])) == Status.EXTRAPOLATED
    )


def test_a_pose_that_is_lost_lets_go_and_a_bad_one_holds_without_force() -> None:
    data, at = holding(middle())
    step(data.model, data, at + np.array([[0.0, 2e-3, 0.0]]))
    assert step(data.model, data, np.full((1, 3), np.nan)) == Status.INVALID_POSE
    assert data.holds(0) and not data.out.force.any()
    assert step(data.model, data, np.full((1, 3), 1e3)) == Status.SLIPPED
    assert not data.holds(0)


def test_another_model_of_the_organ_goes_on_holding() -> None:
    data, at = holding(middle())
    pulled = at + np.array([[0.0, 2e-3, 1e-3]])
    step(data.model, data, pulled)
    force = data.out.force.copy()
    other = model_of(liver(), (jaw_of(),), effects=(Grasp(),)).data()
    other.resume(data)
    step(other.model, other, pulled)
    np.testing.assert_allclose(other.out.force, force, rtol=1e-9)


def test_a_scene_without_its_jaw_lets_go_as_an_open_one(  # while another tool keeps a jaw
) -> None:
    spot, effects = middle(), (Grasp(), SeveralTools())
    bare, far = Tip("sphere", RADIUS), np.full(3, FAR_AWAY)
    data = model_of(liver(), (jaw_of(), jaw_of()), effects=effects).data()
    deep = np.array([spot.tip(4e-3), far])
    step(data.model, data, deep, None, np.zeros(2, bool))
    step(data.model, data, deep, None, np.array([True, False]))
    assert data.holds(0)
    for tips, chosen in (((bare, jaw_of()), effects), ((bare, bare), (SeveralTools(),))):
        other = model_of(liver(), tips, effects=chosen).data()
        other.resume(data)
        for depth, presses in ((4e-3, False), (-4e-3, False), (2e-3, True)):
            step(other.model, other, np.array([spot.tip(depth), far]), None, np.ones(2, bool))
            assert np.isfinite(other.out.force).all() and not other.holds(0)
            assert other.out.force[0].any() == presses


def test_a_jaw_that_is_closed_already_grips_nothing() -> None:
    data = model_of(liver(), (jaw_of(),), effects=(Grasp(),)).data()
    data.note_shut(SHUT)
    step(data.model, data, middle().tip(-ABOVE)[None], None, SHUT)
    assert not data.holds(0)


@pytest.mark.parametrize("depth", [-1e-3, 0.0, 4e-3])
def test_the_torque_of_what_is_held_is_that_of_its_contact(depth: float) -> None:
    data = model_of(liver(), (jaw_of(),), effects=(Grasp(),)).data()
    at = middle().tip(depth)[None]
    step(data.model, data, at, None, OPEN)
    step(data.model, data, at, None, SHUT)
    tip = at + np.array([[1e-3, 2e-3, 1e-3]])
    step(data.model, data, tip)
    lever = data.out.contact_position[0] - tip[0]
    expected = np.cross(lever, data.out.force[0])
    assert np.linalg.norm(data.out.force[0]) > 0.1
    np.testing.assert_allclose(data.out.torque[0], expected, atol=1e-12)


def test_a_tool_that_holds_nothing_presses_as_without_a_jaw() -> None:
    bare = model_of(liver(), (Tip("sphere", RADIUS),), effects=()).data()
    jaw = model_of(liver(), (jaw_of(),), effects=(Grasp(),)).data()
    spot = middle()
    aside = np.cross(spot.normal, np.eye(3)[np.argmin(abs(spot.normal))])
    for part in np.linspace(0.0, 1.0, 20):
        tip = (spot.tip(4e-3 * part - ABOVE) + 3e-3 * part * aside)[None]
        step(bare.model, bare, tip)
        step(jaw.model, jaw, tip, None, OPEN)
    np.testing.assert_allclose(jaw.out.force, bare.out.force, rtol=1e-5)


@pytest.mark.parametrize(
    ("tip", "said"),
    [
        (Tip("sphere", RADIUS), "no tool has a jaw"),
        (Tip("patch", RADIUS, grasp=Jaw()), "a patch has no jaw"),
    ],
)
def test_what_cannot_hold_is_refused(tip: Tip, said: str) -> None:
    with pytest.raises(SceneError, match=said):
        model_of(liver(), (tip,), effects=(Grasp(),))


def test_a_jaw_without_size_is_refused() -> None:
    with pytest.raises(SceneError, match=r"grasp: radius is 0; it must lie in 0.0005 to 0.02 m"):
        Jaw(radius=0)


@pytest.mark.long  # it builds an organ and resolves a disc on it
def test_a_pull_is_that_of_a_resolved_disc(phantom_vademecum: Vademecum) -> None:
    from avatar_core.certify.contact_sites import draw_sites
    from avatar_core.geometry.phantom import phantom_liver
    from avatar_core.studies.grasp import pulls_at

    organ = phantom_liver()
    site = draw_sites(phantom_vademecum, organ, 1, seed=11)[0]
    rows = list(pulls_at(phantom_vademecum, organ, site, 4e-3))
    assert len(rows) == 3
    assert all(row["error"] < 0.15 and row["patch_error"] > 0.2 for row in rows)
