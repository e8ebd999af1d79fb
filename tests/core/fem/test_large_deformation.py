"""Large deformation where it breaks: crushing, inside-out elements, 60 mm, twist, load reversal."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from avatar_core.contact.locate import MAX_DEPTH
from avatar_core.contact.model import Status, prepare, step
from avatar_core.contact.tool_path import middle_of_access
from avatar_core.errors import EquilibriumError
from avatar_core.fem.elasticity import Material
from avatar_core.fem.hyperelastic_materials import (
    HyperelasticMaterial,
    NeoHookean,
    StVenantKirchhoff,
)
from avatar_core.fem.hyperelasticity import Hyperelasticity
from avatar_core.fem.newton import NewtonRule, State, _LoadControl, _LostError, press, solve
from avatar_core.fem.patch_loads import patch_loads, patch_normals
from avatar_core.geometry.mesh import TetMesh, make_mesh
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.model import Vademecum
from tests.core.conftest import box_mesh, box_regions
from tests.helpers.examples import examples
from tests.helpers.soft_box import (
    LENGTH,
    accepted_steps,
    box,
    carried,
    followed,
    held,
    least_det,
    nodes_of,
    stored_and_done,
    stretched,
)

Figure = Callable[[str], None]

YOUNG = 1000.0
CORK = Material(YOUNG, 0.0)  # a column of it does not swell: stretched alone, it is a closed form
SOFT = Material(YOUNG, 0.4)
CRITICAL = 1.0 / np.sqrt(3.0)  # stretch at which d/ds (s^3 - s) = 0
ROTATION = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
ROUNDING = 1e-9  # of a displacement that the elements hold exactly, over the length

MATERIALS = {"StVK": StVenantKirchhoff, "neo-Hookean": NeoHookean}
both = pytest.mark.parametrize("kind", MATERIALS.values(), ids=list(MATERIALS))


def column(problem: Hyperelasticity) -> tuple[np.ndarray, np.ndarray]:
    """Loads and motion that shorten a column by one, plane section by plane section."""
    y = nodes_of(problem)[:, 1]
    top, inside = np.flatnonzero(y > 0.999 * LENGTH), np.flatnonzero(y > 1e-9)
    dofs = np.concatenate([3 * top + 1, 3 * inside, 3 * inside + 2])
    return held(problem, dofs), np.concatenate([-np.ones(len(top)), np.zeros(2 * len(inside))])


def column_force(kind: type, s: float) -> float:
    """Push on the column at a stretch; Poisson's ratio zero: E = 2 mu, lambda = 0 [N]."""
    curve = (s - s**3) if kind is StVenantKirchhoff else (1.0 / s - s)
    return YOUNG / 2.0 * curve * LENGTH**2


def even_pressure(problem: Hyperelasticity) -> np.ndarray:
    """A dead load of 1 N down on the top face, evenly spread, shape (3 n_nodes,)."""
    forces = problem.forces(stretched(problem, 1.01)).reshape(-1, 3)
    down = np.zeros_like(forces)
    top = nodes_of(problem)[:, 1] > 0.999 * LENGTH
    down[top, 1] = -forces[top, 1] / forces[top, 1].sum()
    return down.ravel()


# --- 42 % compression -------------------------------------------------------------------------


@both
@pytest.mark.parametrize("n", [2, 3])
def test_42_percent_compression(kind: type, n: int, figure: Figure) -> None:
    """The closed form up to 42 %; beyond 1 - 1/sqrt(3) St Venant-Kirchhoff has no equilibrium."""
    problem = box(kind(CORK), n)
    squeezed, motion = column(problem)
    shares = np.array([0.1, 0.2, 0.3, 0.4, 0.42, 0.43, 0.6])
    rule = NewtonRule(least_step=2.0**-10)
    states, lost = carried(press(problem, squeezed, motion, list(LENGTH * shares), rule))
    worst = 0.0
    for state in states:
        s = 1.0 - state.depth / LENGTH
        worst = max(worst, abs(state.force @ motion / column_force(kind, s) - 1.0))
        assert np.abs(state.displacement - stretched(problem, s)).max() < ROUNDING * LENGTH
        assert state.min_det == pytest.approx(s, abs=ROUNDING)
    assert worst < ROUNDING
    reached = states[-1].depth / LENGTH
    if kind is NeoHookean:
        assert not lost and reached == pytest.approx(0.6)
    else:
        assert reached == pytest.approx(0.42) and "neo-Hookean" in lost
        beyond = float(re.findall(r"depth \[m\] (\S+) of", lost)[0])
        # the step that is last tried, and three digits in the message
        assert beyond == pytest.approx(LENGTH * (1.0 - CRITICAL), abs=0.06 * rule.least_step + 5e-5)
        reached = beyond / LENGTH
    figure(f"force off the closed form by {worst:.0e}, carried to {100 * reached:.1f} %")


@pytest.mark.parametrize("share", [0.6, 0.99])
def test_dead_load_is_refused_where_it_is_lost_and_not_later(share: float, figure: Figure) -> None:
    """What is said to be carried is carried, what is said to be lost is lost."""
    problem = box(StVenantKirchhoff(CORK), 2)
    pressure = even_pressure(problem)
    # the most that s - s^3 gives; a free column buckles before
    load = share * YOUNG * LENGTH**2 / (3.0 * np.sqrt(3.0)) * pressure
    with pytest.raises(EquilibriumError) as refused:
        solve(problem, load)
    carried = float(re.findall(r"factor (\S+) of", str(refused.value))[0])
    state = solve(problem, 0.99 * carried * load)  # three digits are printed
    assert problem.factorize(problem.tangent(state.displacement)).inertia[1:] == (0, 0)
    with pytest.raises(EquilibriumError):
        solve(problem, (1.01 * carried + NewtonRule().least_step) * load)
    figure(f"lost at {share * carried:.3f} of the largest force of a column that stays straight")


# --- elements turned inside out ---------------------------------------------------------------


@pytest.mark.parametrize("overload", [1.05, 1.5])
def test_newton_alone_converges_to_an_inside_out_organ(overload: float, figure: Figure) -> None:
    """Its forces balance and all pivots are positive; the organ is a mirror image, and refused."""
    problem = box(StVenantKirchhoff(CORK))
    load = overload * YOUNG * LENGTH**2 / (3.0 * np.sqrt(3.0)) * even_pressure(problem)
    u, free = stretched(problem, -1.2), problem.free
    for _ in range(10):
        residual = (problem.forces(u) - load)[free]
        u[free] -= problem.factorize(problem.tangent(u)).solve(residual)
    left = np.linalg.norm((problem.forces(u) - load)[free]) / np.linalg.norm(load)
    assert left < 1e-10
    assert problem.factorize(problem.tangent(u)).inertia[1:] == (0, 0)
    det = least_det(problem, u)
    assert det < -1.0
    assert problem.energy(u) == np.inf
    newton = _LoadControl(problem, load[free], NewtonRule())
    for there, aim in ((u, 1.0), (stretched(problem, -1.2), 0.9)):
        turned = State(there, np.ones(1), 0.0, np.zeros(1), det, 0)
        with pytest.raises(_LostError, match="inside out"):
            newton.advance(turned, aim)
    with accepted_steps() as states, pytest.raises(EquilibriumError):
        solve(problem, load)
    assert all(least_det(problem, state.displacement) > 0.0 for state in states)
    figure(f"residual {left:.0e} at det F {det:.2f}: refused")


@examples(25, least=10)  # enough for some to be refused
@given(
    kind=st.sampled_from(list(MATERIALS)),
    nu=st.sampled_from([0.0, 0.3, 0.45]),
    direction=st.tuples(*3 * [st.floats(-1.0, 1.0)]).filter(lambda d: np.linalg.norm(d) > 0.1),
    size=st.floats(0.05, 20.0),
    where=st.floats(0.02, 0.08),
)
@example(kind="StVK", nu=0.4, direction=(0.0, -1.0, 0.0), size=2.0, where=0.05)
def check_no_step_inverts(
    kind: str, nu: float, direction: tuple[float, float, float], size: float, where: float
) -> None:
    problem = box(MATERIALS[kind](Material(YOUNG, nu)))
    patch = patch_loads(problem.linear, np.array([[where, LENGTH, 0.05]]), 0.04)
    load = patch @ (size * np.array(direction) / np.linalg.norm(direction))
    with accepted_steps() as states:
        try:
            state = solve(problem, load)
        except EquilibriumError as error:
            assert "\n" not in str(error)
            tally["refused"] += 1
        else:
            out = (problem.forces(state.displacement) - load)[problem.free]
            assert np.linalg.norm(out) < 1e-5 * np.linalg.norm(load)
    dets = [least_det(problem, state.displacement) for state in states]
    assert min(dets, default=1.0) > 0.0
    tally["steps"] += len(dets)
    tally["least"] = min([tally["least"], *dets])


tally: dict[str, float] = {}


@pytest.mark.examples
def test_no_accepted_step_holds_an_inverted_element(figure: Figure) -> None:
    """Under dead loads of 0.05 to 20 N on a soft box, in any direction."""
    tally.update(refused=0, steps=0, least=1.0)
    check_no_step_inverts()
    assert tally["steps"] > 20 and tally["refused"] > 0
    figure(
        f"least det F {tally['least']:.3f} in {tally['steps']:.0f} steps; "
        f"{tally['refused']:.0f} loads refused"
    )


# --- pull and push to 60 mm -------------------------------------------------------------------


def lobe() -> tuple[TetMesh, np.ndarray]:
    """A rounded slab of 140 x 100 x 120 mm, always the same, and its clamped underside."""
    cube = box_mesh(4, (2.0, 2.0, 2.0))
    corner = cube.vertices - 1.0
    x, y, z = corner.T**2
    ball = corner * np.sqrt(
        1.0 - np.stack([y + z - 2 * y * z / 3, z + x - 2 * z * x / 3, x + y - 2 * x * y / 3], 1) / 2
    )
    mesh = make_mesh((0.6 * ball + 0.4 * corner) * [0.07, 0.05, 0.06], cube.tets)
    return mesh, box_regions(cube).clamped


@pytest.mark.parametrize(
    ("name", "way", "spacing", "bearable"),
    [
        ("StVK", "push", 0.75e-3, 8e-3),
        ("StVK", "pull", 2.5e-3, 45e-3),
        ("neo-Hookean", "push", 1.25e-3, 27e-3),
        ("neo-Hookean", "pull", 2.5e-3, 60e-3),
    ],
)
def test_60_mm(name: str, way: str, spacing: float, bearable: float, figure: Figure) -> None:
    """All the way or refused with the depth reached; until there, what was done is stored.

    bearable : depth at which the organ has an equilibrium, so that refusing it is wrong [m]
    """
    mesh, clamped = lobe()
    top = mesh.surface_vertices
    nearest = np.linalg.norm(mesh.vertices[top] - [0.03, 0.05, 0.0], axis=1).argmin()
    at, radius = mesh.vertices[[top[nearest]]], 20e-3
    problem = Hyperelasticity(mesh, MATERIALS[name](Material(YOUNG, 0.45)), clamped)
    patch = patch_loads(problem.linear, at, radius).toarray()
    motion = {"push": -1.0, "pull": 1.0}[way] * patch_normals(mesh, at, radius)[0]
    with accepted_steps() as steps:
        states, lost = carried(
            press(problem, patch, motion, list(np.arange(spacing, 60.1e-3, spacing)))
        )
    least = min(least_det(problem, state.displacement) for state in steps)
    assert least > 0.0
    depths = np.array([0.0, *(state.depth for state in states)])
    forces = np.array([0.0, *(state.force @ motion for state in states)])
    energy = np.array([0.0, *(problem.energy(state.displacement) for state in states)])
    assert depths[-1] > bearable - 1e-9
    if lost:
        assert depths[-1] <= float(re.findall(r"depth \[m\] (\S+) of", lost)[0]) + 5e-5
    else:
        assert depths[-1] == pytest.approx(60e-3)
    work, error = stored_and_done(depths, forces)
    assert error < 1e-3 * energy[-1]
    # of the force, which is as accurate as the residual
    assert np.abs(work - energy)[3:].max() < error + 2e-6 * energy[-1]
    assert (np.diff(energy) > 0.0).all() and (forces[1:] > 0.0).all()
    balance = abs(work[-1] / energy[-1] - 1.0)
    end = "refused beyond" if lost else "reached"
    figure(f"{end} {1e3 * depths[-1]:.1f} mm, work - energy {balance:.0e}, least det F {least:.2f}")


# --- twist of 90 degrees ----------------------------------------------------------------------


def bar() -> TetMesh:
    """40 x 100 x 40 mm along y about the origin, equal to its mirror image in x = 0."""
    half = box_mesh(2, (0.02, LENGTH, 0.04))
    vertices = half.vertices - [0.0, 0.0, 0.02]
    vertices = np.concatenate([vertices, vertices * [-1.0, 1.0, 1.0]])
    tets = np.concatenate([half.tets, half.tets[:, [0, 2, 1, 3]] + len(half.vertices)])
    _, first, number = np.unique(vertices.round(6), axis=0, return_index=True, return_inverse=True)
    return make_mesh(vertices[first], number.reshape(-1)[tets])


def twisted(
    material: HyperelasticMaterial, angles: np.ndarray, frame: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Torques and energies at these angles of the bar's end, and the least det F.

    frame : rotation of bar, clamp and axis
    """
    straight = bar()
    mesh = make_mesh(straight.vertices @ frame.T, straight.tets)
    y = straight.vertices[straight.boundary_faces][:, :, 1]
    problem = Hyperelasticity(mesh, material, (y < 1e-9).all(axis=1))
    nodes = nodes_of(problem) @ frame
    end = np.flatnonzero(nodes[:, 1] > 0.999 * LENGTH)
    x, y, z = nodes[end].T
    turned = [
        np.column_stack([np.cos(a) * x + np.sin(a) * z, y, np.cos(a) * z - np.sin(a) * x])
        for a in (0.0, *angles)
    ]
    grip = held(problem, (3 * end[:, None] + np.arange(3)).ravel())
    motions = [(frame @ step.T).T.ravel() for step in np.diff(turned, axis=0)]
    torque, energy, least = [], [], 1.0
    for state, at in zip(followed(problem, grip, motions), turned[1:], strict=True):
        force = state.force.reshape(-1, 3) @ frame
        torque.append(np.cross(at, force).sum(axis=0)[1])
        energy.append(problem.energy(state.displacement))
        least = min(least, least_det(problem, state.displacement))
    return np.array(torque), np.array(energy), least


@pytest.mark.long
@both
def test_twist_of_90_degrees(kind: type, figure: Figure) -> None:
    """The torque does the work that is stored; reversed, or elsewhere in space, it is the same."""
    angles = np.radians(np.arange(15.0, 91.0, 15.0))
    torque, energy, least = twisted(kind(SOFT), angles, np.eye(3))
    assert least > 0.0
    assert (np.diff([0.0, *energy]) > 0.0).all() and (np.diff([0.0, *torque]) > 0.0).all()
    work, error = stored_and_done(np.array([0.0, *angles]), np.array([0.0, *torque]))
    assert error < 1e-3 * energy[-1]
    assert np.abs(work[1:] - energy).max() < error + 2e-6 * energy[-1]
    # equal up to the residual of Newton's method, squared in the energy
    back, same, _ = twisted(kind(SOFT), -angles, np.eye(3))
    asymmetry = np.abs(back / torque + 1.0).max()
    assert asymmetry < 1e-6 and np.abs(same / energy - 1.0).max() < 1e-9
    elsewhere, same, _ = twisted(kind(SOFT), angles, ROTATION)
    assert np.abs(elsewhere / torque - 1.0).max() < 1e-6
    assert np.abs(same / energy - 1.0).max() < 1e-9
    figure(
        f"torque {1e3 * torque[-1]:.2f} mN m, reversed off by {asymmetry:.0e}, work - energy "
        f"{abs(work[-1] / energy[-1] - 1.0):.0e}, least det F {least:.2f}"
    )


# --- load reversal ----------------------------------------------------------------------------


@both
def test_push_release_pull_release(kind: type, figure: Figure) -> None:
    """Nothing is left behind, and every state is the one that is reached from rest."""
    problem = box(kind(SOFT), 3)
    patch = patch_loads(problem.linear, np.array([[0.05, LENGTH, 0.05]]), 0.04).toarray()
    depth, remainder = 6e-3, 1e-6  # residuals are over the force: it must not vanish altogether
    path = depth * np.array([1.0, remainder, -1.0, -remainder, 1.0])
    inward = np.array([0.0, -1.0, 0.0])
    motions = [step * inward for step in np.diff([0.0, *path])]
    states = list(followed(problem, patch, motions))
    size = np.abs(states[0].displacement).max()
    off, energy = [], []
    for state, at in zip(states, path, strict=True):
        fresh = next(press(problem, patch, np.sign(at) * inward, [abs(at)]))
        off.append(np.abs(state.displacement - fresh.displacement).max() / size)
        energy.append(problem.energy(state.displacement))
        assert least_det(problem, state.displacement) > 0.0
    assert max(off) < 1e-6  # of the tolerance of the residual
    for released in (1, 3):
        assert np.abs(states[released].displacement).max() < 1.1 * remainder * size
        assert energy[released] < 2.0 * remainder**2 * energy[0]
    assert energy[4] == pytest.approx(energy[0], rel=1e-9)
    figure(f"left of {1e3 * size:.1f} mm beside a push from rest: {1e9 * size * max(off):.2g} nm")


@both
def test_weight_first_or_push_first(kind: type, figure: Figure) -> None:
    """The state does not depend on the order in which its loads came."""
    problem = box(kind(SOFT), 3)
    push = patch_loads(problem.linear, np.array([[0.05, LENGTH, 0.05]]), 0.04).toarray()[:, 1]
    side = patch_loads(problem.linear, np.array([[LENGTH, 0.07, 0.05]]), 0.04).toarray()[:, 0]
    side = 0.2 * side
    one = next(press(problem, -push, np.ones(1), [4e-3], preload=side))
    both_at_once = solve(problem, side - one.force[0] * push)
    other = next(press(problem, side, np.ones(1), [1e-3], preload=-one.force[0] * push))
    further = solve(problem, other.force[0] * side - one.force[0] * push)
    size = np.abs(one.displacement).max()
    off = np.abs(both_at_once.displacement - one.displacement).max() / size
    assert off < 1e-6
    assert np.abs(further.displacement - other.displacement).max() < 1e-6 * size
    figure(f"apart by {off:.0e} of the displacement")


@pytest.mark.long
def test_contact_returns_the_work_of_a_deep_push(bent: Vademecum, figure: Figure) -> None:
    """In steps of 1 kHz: loading and release are one curve, within the reach and beyond it."""
    radius = 20e-3  # the force on a smaller sphere stays within the reach
    model = prepare(bent, (Tip("sphere", radius),), cloud="volume")
    j = middle_of_access(bent)
    center, normal = bent.surface.centers[j], bent.surface.normals[j]

    def path(depths: np.ndarray) -> tuple[np.ndarray, list[int]]:
        status, force = [], []
        for depth in depths:
            status.append(step(model, (center + (radius - depth) * normal)[None]))
            force.append(model.out.force[0] @ normal)
            if force[-1] != 0.0:
                assert -model.state.gap[0] < MAX_DEPTH + radius  # of the centre, the tip is deeper
        return np.array(force), status

    down = np.arange(-5e-3, 28e-3, 0.25e-3)
    pushed, status = path(down)
    assert set(status) == {Status.OK, Status.EXTRAPOLATED}
    assert (np.diff(pushed[pushed > 0.0]) > 0.0).all()
    released, _ = path(down[::-1])
    assert not model.out.force.any() and not model.out.cloud[:, 3:].any()
    again, _ = path(down)
    largest = pushed.max()
    off = np.abs(released[::-1] - pushed).max() / largest
    assert off < 1e-9 and np.abs(again - pushed).max() < 1e-9 * largest
    path(down[::-1])
    _, status = path(np.arange(-5e-3, 61e-3, 0.5e-3))
    assert set(status[status.index(Status.OUT_OF_RANGE) :]) == {Status.OUT_OF_RANGE}
    assert not model.out.force.any()
    figure(f"{largest:.0f} N at 28 mm, loading and release apart by {off:.0e}; refused at 60 mm")
