"""Newton's method: small loads, steps, crushing, inside-out elements, 60 mm, load reversal."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import pytest

from avatar_core.errors import AvatarError, EquilibriumError, LoadError, MaterialError
from avatar_core.fem.elasticity import Material
from avatar_core.fem.hyperelastic_materials import NeoHookean, StVenantKirchhoff
from avatar_core.fem.hyperelasticity import Hyperelasticity
from avatar_core.fem.newton import NewtonRule, State, _LoadControl, _LostError, press, solve
from avatar_core.fem.patch_loads import patch_loads, patch_normals
from avatar_core.geometry.mesh import TetMesh, make_mesh
from tests.helpers.elastic_shapes import box_mesh, box_regions, nodes_of
from tests.helpers.soft_box import (
    LENGTH,
    SOFT,
    YOUNG,
    accepted_steps,
    bent,
    box,
    carried,
    followed,
    held,
    least_det,
    stored_and_done,
    stretched,
)

Figure = Callable[[str], None]

CORK = Material(YOUNG, 0.0)  # a column of it does not swell: uniaxial stretch has a closed form
CRITICAL = 1.0 / np.sqrt(3.0)  # stretch at which d/ds (s^3 - s) = 0
ROUNDING = 1e-9  # error of an exactly represented displacement, relative to the length

MATERIALS = {"StVK": StVenantKirchhoff, "neo-Hookean": NeoHookean}
both = pytest.mark.parametrize("kind", MATERIALS.values(), ids=list(MATERIALS))


def column(problem: Hyperelasticity) -> tuple[np.ndarray, np.ndarray]:
    """Return loads and motion that shorten a column by one, plane section by plane section."""
    y = nodes_of(problem)[:, 1]
    top, inside = np.flatnonzero(y > 0.999 * LENGTH), np.flatnonzero(y > 1e-9)
    dofs = np.concatenate([3 * top + 1, 3 * inside, 3 * inside + 2])
    return held(problem, dofs), np.concatenate([-np.ones(len(top)), np.zeros(2 * len(inside))])


def column_force(kind: type, s: float) -> float:
    """Return the push on the column at a stretch; nu = 0: E = 2 mu, lambda = 0 [N]."""
    curve = (s - s**3) if kind is StVenantKirchhoff else (1.0 / s - s)
    return YOUNG / 2.0 * curve * LENGTH**2


def even_pressure(problem: Hyperelasticity) -> np.ndarray:
    """Return a dead load of 1 N down on the top face, evenly spread, shape (3 n_nodes,)."""
    forces = problem.forces(stretched(problem, 1.01)).reshape(-1, 3)
    down = np.zeros_like(forces)
    top = nodes_of(problem)[:, 1] > 0.999 * LENGTH
    down[top, 1] = -forces[top, 1] / forces[top, 1].sum()
    return down.ravel()


def push_on(problem: Hyperelasticity) -> np.ndarray:
    """Return a unit patch load down on the middle of the top face."""
    unit = patch_loads(problem.linear, np.array([[0.05, LENGTH, 0.05]]), 0.04)
    return np.asarray(unit @ [0.0, -1.0, 0.0]).ravel()


# --- steps --------------------------------------------------------------------------------------


@both
def test_newton_finds_a_large_strain_quadratically(kind: type) -> None:
    """The forces that hold a bent box bend a straight one, the residual squared every time."""
    problem = box(kind(SOFT))
    exact = bent(problem)
    load = np.zeros_like(exact)
    load[problem.free] = problem.forces(exact)[problem.free]
    state = solve(problem, load, NewtonRule(tolerance=1e-12))
    assert np.linalg.norm(state.displacement - exact) < 1e-9 * np.linalg.norm(exact)
    r = state.residuals
    # far away convergence is slower, near the solution rounding dominates
    near = (r[:-1] < 0.1) & (r[1:] > 1e-10)
    assert near.sum() >= 1
    assert (r[1:] < 10.0 * r[:-1] ** 2)[near].all()


@both
def test_small_load_moves_as_in_linear_elasticity(kind: type) -> None:
    """The difference is of second order: 1e-5 of strain, 1e-5 of the displacement or less."""
    problem = box(kind(SOFT), 3)
    push = push_on(problem)
    linear = problem.linear.solve(push[:, None])[:, 0]
    state = next(press(problem, push, np.ones(1), [1e-6]))
    expected = linear * 1e-6 / (push @ linear)
    assert np.linalg.norm(state.displacement - expected) < 1e-4 * np.linalg.norm(expected)
    assert state.force[0] == pytest.approx(1e-6 / (push @ linear), rel=1e-4)


def test_unstable_states_are_refused() -> None:
    """Pivots show it where a state is returned, conjugate gradients on the way there."""
    mesh = box_mesh(2)
    problem = Hyperelasticity(mesh, StVenantKirchhoff(SOFT), np.ones_like(mesh.face_areas, bool))
    crushed = stretched(problem, 0.5)
    load = np.random.default_rng(6).normal(size=len(problem.free))
    newton = _LoadControl(problem, load, NewtonRule())
    state = State(crushed, np.zeros(1), 0.0, np.zeros(1), 0.5, 0)
    with pytest.raises(_LostError, match="nothing resists"):
        newton.check_stability(state)
    with pytest.raises(_LostError, match="positive definite"):
        newton.advance(state, 1e-6)
    newton.check_stability(newton.rest)


def test_line_search_shortens_a_step_that_goes_too_far() -> None:
    """A downhill step 40 times too long turns elements over; a part of it lowers the energy."""
    problem = box(NeoHookean(SOFT))
    load = 0.2 * push_on(problem)
    free, rest = load[problem.free], np.zeros_like(load)
    far = 40.0 * problem.linear.solve(load[:, None])[problem.free, 0]
    newton = _LoadControl(problem, free, NewtonRule())
    u = newton._line_search(rest, free, -free, far)
    assert problem.energy(u) - load @ u < 0.0
    with pytest.raises(_LostError, match="inside out"):
        newton._line_search(rest, free, -free, 1e4 * far)


def test_impossible_problems_are_refused_in_one_line() -> None:
    problem = box(NeoHookean(SOFT))
    push, mesh = push_on(problem), box_mesh(2)
    nowhere = np.zeros(len(mesh.boundary_faces), bool)
    locking = NeoHookean(Material(1000.0, 0.499))
    cases: list[tuple[type[AvatarError], str, Callable[[], object]]] = [
        (MaterialError, "lock", lambda: box(locking)),
        (MaterialError, "clamp", lambda: Hyperelasticity(mesh, NeoHookean(SOFT), nowhere)),
        (LoadError, "shape", lambda: solve(problem, push[:-1])),
        (LoadError, "finite", lambda: solve(problem, push * np.nan)),
        (LoadError, "zero", lambda: solve(problem, 0.0 * push)),
        (LoadError, "increasing", lambda: list(press(problem, push, np.ones(1), [0.002, 0.001]))),
        (LoadError, "increasing", lambda: list(press(problem, push, np.ones(1), []))),
    ]
    for error, message, call in cases:
        with pytest.raises(error, match=message) as raised:
            call()
        assert "\n" not in str(raised.value)


# --- 42 % compression -------------------------------------------------------------------------


@both
def test_42_percent_compression(kind: type, figure: Figure) -> None:
    """The closed form up to 42 %; beyond 1 - 1/sqrt(3) St Venant-Kirchhoff has no equilibrium."""
    problem = box(kind(CORK))
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
    """Equilibrium exists below the reported load, and none above it."""
    problem = box(StVenantKirchhoff(CORK), 2)
    pressure = even_pressure(problem)
    # the maximum of s - s^3; a free column buckles before
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


@both
def test_no_accepted_step_holds_an_inverted_element(kind: type) -> None:
    """Under this dead load an element once turned inside out at a corner."""
    problem = box(kind(SOFT))
    with accepted_steps() as states, suppress(EquilibriumError):
        solve(problem, 2.0 * push_on(problem))
    assert len(states) > 1
    assert all(least_det(problem, state.displacement) > 0.0 for state in states)


# --- pull and push to 60 mm -------------------------------------------------------------------


def lobe() -> tuple[TetMesh, np.ndarray]:
    """Return a rounded slab of 140 x 100 x 120 mm, always the same, and its clamped underside."""
    cube = box_mesh(4, (2.0, 2.0, 2.0))
    corner = cube.vertices - 1.0
    x, y, z = corner.T**2
    ball = corner * np.sqrt(
        1.0 - np.stack([y + z - 2 * y * z / 3, z + x - 2 * z * x / 3, x + y - 2 * x * y / 3], 1) / 2
    )
    mesh = make_mesh((0.6 * ball + 0.4 * corner) * [0.07, 0.05, 0.06], cube.tets)
    return mesh, box_regions(cube).clamped


@pytest.mark.long
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
    """It reaches 60 mm, or is refused with the depth reached; until there, work is stored.

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
    # relative to the force, which is as accurate as the residual
    assert np.abs(work - energy)[3:].max() < error + 2e-6 * energy[-1]
    assert (np.diff(energy) > 0.0).all() and (forces[1:] > 0.0).all()
    balance = abs(work[-1] / energy[-1] - 1.0)
    end = "refused beyond" if lost else "reached"
    figure(f"{end} {1e3 * depths[-1]:.1f} mm, work - energy {balance:.0e}, least det F {least:.2f}")


# --- load reversal ----------------------------------------------------------------------------


@both
def test_push_release_pull_release(kind: type, figure: Figure) -> None:
    """No history is left, and every state equals the one reached from rest."""
    problem = box(kind(SOFT))
    patch = patch_loads(problem.linear, np.array([[0.05, LENGTH, 0.05]]), 0.04).toarray()
    # residuals are relative to the force: it must not vanish altogether
    depth, remainder = 6e-3, 1e-6
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
    assert max(off) < 1e-6  # the residual's tolerance
    for released in (1, 3):
        assert np.abs(states[released].displacement).max() < 1.1 * remainder * size
        assert energy[released] < 2.0 * remainder**2 * energy[0]
    assert energy[4] == pytest.approx(energy[0], rel=1e-9)
    figure(f"left of {1e3 * size:.1f} mm beside a push from rest: {1e9 * size * max(off):.2g} nm")


@both
def test_weight_first_or_push_first(kind: type, figure: Figure) -> None:
    """The state does not depend on the order in which its loads came."""
    problem = box(kind(SOFT))
    push = -push_on(problem)
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
