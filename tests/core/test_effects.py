"""Every effect against a result that someone can check, and absent where nobody asks for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse.linalg as sla
from skfem import Basis, BilinearForm, ElementTetP1, ElementTetP2, ElementVector, MeshTet
from skfem.helpers import dot

from avatar_core.contact import ContactModel, Layout, Status, lay_out, prepare, step
from avatar_core.effects import (
    EFFECTS,
    Effect,
    Friction,
    Inertia,
    Respiration,
    SelfWeight,
    SeveralTools,
    Viscoelasticity,
)
from avatar_core.effects.inertia import kinetic_energy, turned_modes
from avatar_core.elasticity import Elasticity
from avatar_core.errors import SceneError
from avatar_core.loads import patch_loads
from avatar_core.tool_path import inner_positions, middle_of_access
from avatar_core.vademecum import Vademecum

from .flat_organ import COMPLIANCE, RADIUS, at_depth, flat_organ

TIP = 10e-3
CHOICES: dict[str, tuple[Effect, str]] = {
    "several_tools": (SeveralTools(), "several"),
    "friction": (Friction(), "friction"),
    "viscoelasticity": (Viscoelasticity((0.3, 0.2), (0.05, 1.0)), "memory"),
    "inertia": (Inertia(), "inertia"),
    "self_weight": (SelfWeight(), "weight"),
    "respiration": (Respiration(period=0.5), "motion"),
}


def push_and_drag(v: Vademecum, n: int = 60) -> np.ndarray:
    """Into the organ and along it, shape (n, 3)."""
    j = middle_of_access(v)
    center, normal = v.surface.centers[j], v.surface.normals[j]
    along = np.linalg.svd(normal[None])[2][1]
    t = np.linspace(0.0, 1.0, n)[:, None]
    return center + (TIP - 6e-3 * np.minimum(2 * t, 1.0)) * normal + 4e-3 * t * along


def forces(model: ContactModel, path: np.ndarray) -> np.ndarray:
    model.reset()
    out = []
    for tip in path:
        step(model, np.tile(tip, (model.n_tools, 1)))
        out.append(model.out.force[0].copy())
    return np.array(out)


# --- Absent when off ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", CHOICES)
def test_an_effect_is_absent_from_the_step_when_off(
    phantom_vademecum: Vademecum, name: str
) -> None:
    """No argument of the compiled step, no array in the model: only None."""
    effect, argument = CHOICES[name]
    without = prepare(phantom_vademecum, (TIP,), cloud="off", effects=())
    with_it = prepare(phantom_vademecum, (TIP,), cloud="off", effects=(effect,))
    assert getattr(without.effects, argument) is None
    assert getattr(with_it.effects, argument) is not None
    assert all(value is None for value in without.effects)
    assert not [key for key in without.layout.flat() if "." in key]
    assert [key for key in with_it.layout.flat() if key.startswith(f"{argument}.")]
    others = [a for _, a in CHOICES.values() if a != argument]
    assert all(getattr(with_it.effects, other) is None for other in others)


def test_the_bare_step_is_compiled_for_no_effect(phantom_vademecum: Vademecum) -> None:
    """Its signature ends in eight times none, and its code names no function of an effect."""
    import numba

    from avatar_core import contact_kernels as kernels

    model = prepare(phantom_vademecum, (TIP,), cloud="off", effects=())
    arguments = (model.arrays, model.state, model.out, model.tips, *model.effects)
    signature = tuple(numba.typeof(argument) for argument in arguments)
    assert [str(kind) for kind in signature[4:]] == ["none"] * 8
    assert signature in kernels.contact_step.overloads


@pytest.mark.parametrize("name", [name for name in CHOICES if name != "several_tools"])
def test_an_effect_changes_the_result_when_on(phantom_vademecum: Vademecum, name: str) -> None:
    effect, _ = CHOICES[name]
    path = push_and_drag(phantom_vademecum)
    bare = forces(prepare(phantom_vademecum, (TIP,), cloud="off", effects=()), path)
    changed = forces(prepare(phantom_vademecum, (TIP,), cloud="off", effects=(effect,)), path)
    assert np.abs(bare).max() > 1.0
    assert np.abs(changed - bare).max() > 1e-3 * np.abs(bare).max()


def test_the_list_of_effects_is_complete() -> None:
    assert set(CHOICES) | {"large_deformation", "tumour"} == set(EFFECTS)


def test_a_layout_survives_being_flat(phantom_vademecum: Vademecum) -> None:
    effects = tuple(effect for effect, _ in CHOICES.values())
    layout = lay_out(phantom_vademecum, (TIP,), cloud="off", effects=effects)
    again = Layout.of(layout.flat())
    for a, b in zip(layout.effects, again.effects, strict=True):
        assert (a is None) == (b is None)
        assert a is None or all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


# --- Friction -----------------------------------------------------------------------------------


def test_a_dragged_tip_sticks_up_to_the_static_limit_and_slips_with_the_kinetic_force() -> None:
    """On the flat organ: tau = x / C until mu_s F_n, then mu_k F_n, against the motion."""
    mu_s, mu_k, depth = 0.5, 0.3, 4e-3
    model = flat_organ((Friction(mu_s, mu_k),))
    normal = depth / COMPLIANCE
    step(model, at_depth(depth))
    tangential = []
    ways = np.linspace(0.0, 4e-3, 401)
    for x in ways:
        assert step(model, at_depth(depth, x)) == Status.OK
        assert model.out.force[0, 2] == pytest.approx(normal, rel=1e-6)
        assert abs(model.out.force[0, 1]) < 1e-6
        tangential.append(-model.out.force[0, 0])
    tangential = np.array(tangential)
    sticks = ways < (1.0 - 1e-6) * mu_s * depth  # x / C < mu_s depth / C
    np.testing.assert_allclose(
        tangential[sticks], ways[sticks] / COMPLIANCE, rtol=1e-6, atol=1e-6 * normal
    )
    np.testing.assert_allclose(tangential[~sticks][1:], mu_k * normal, rtol=1e-6)


def test_friction_turns_back_elastically() -> None:
    """After slip the force falls by dx / C on the way back: the tip sticks again."""
    depth, model = 4e-3, flat_organ((Friction(0.3, 0.3),))
    step(model, at_depth(depth))
    for x in np.linspace(0.0, 3e-3, 100):
        step(model, at_depth(depth, x))
    slipping = model.out.force[0, 0]
    step(model, at_depth(depth, 2.9e-3))
    assert model.out.force[0, 0] - slipping == pytest.approx(0.1e-3 / COMPLIANCE, rel=1e-3)


def test_friction_has_its_moment_about_the_tip() -> None:
    model = flat_organ((Friction(0.5, 0.5),))
    step(model, at_depth(4e-3))
    step(model, at_depth(4e-3, 1e-3))
    arm = np.array([0.0, 0.0, -RADIUS])
    np.testing.assert_allclose(model.out.torque[0], np.cross(arm, model.out.force[0]), atol=1e-12)


def test_a_turning_tool_drags_the_tissue_along() -> None:
    """A turn by theta about y moves the contact point by theta x (0, 0, -r)."""
    model = flat_organ((Friction(1.0, 1.0),))
    step(model, at_depth(4e-3))
    model.effects.friction.spin[0] = (0.0, 0.1, 0.0)
    step(model, at_depth(4e-3))
    moved = np.cross((0.0, 0.1, 0.0), (0.0, 0.0, -RADIUS))
    assert model.out.force[0, 0] == pytest.approx(-moved[0] / COMPLIANCE, rel=1e-5)


def test_without_coefficients_friction_is_none(phantom_vademecum: Vademecum) -> None:
    """mu = 0 gives the frictionless force, found in another way, to single precision."""
    path = push_and_drag(phantom_vademecum)
    bare = forces(prepare(phantom_vademecum, (TIP,), cloud="off", effects=()), path)
    smooth = forces(
        prepare(phantom_vademecum, (TIP,), cloud="off", effects=(Friction(0.0, 0.0),)), path
    )
    np.testing.assert_allclose(smooth, bare, atol=2e-5 * np.abs(bare).max())


def test_what_sticks_gives_back_what_it_got(phantom_vademecum: Vademecum) -> None:
    """The force of a tip that never slips is the derivative of the energy, to 1 in 1,000."""
    v = phantom_vademecum
    model = prepare(v, (TIP,), cloud="off", effects=(Friction(1.0, 1.0),))
    j = middle_of_access(v)
    center, normal = v.surface.centers[j], v.surface.normals[j]
    one, other = np.linalg.svd(normal[None])[2][1:]
    low = center + (TIP - 4e-3) * normal
    t = np.linspace(0.0, 2 * np.pi, 400)[:, None]
    circle = (
        low
        + 0.6e-3 * (np.sin(t) * one + (1.0 - np.cos(t)) * other)
        + 0.3e-3 * np.sin(2 * t) * normal
    )
    step(model, low[None])
    step(model, low[None])
    felt = []
    for tip in circle:
        step(model, tip[None])
        assert model.effects.friction.slipped[0] == 0.0
        felt.append(model.out.force[0].copy())
    each = (0.5 * (np.array(felt[1:]) + felt[:-1]) * np.diff(circle, axis=0)).sum(axis=1)
    assert abs(each.sum()) < 1e-3 * np.abs(each).sum()


def random_loop(v: Vademecum, rng: np.random.Generator, n: int) -> np.ndarray:
    """Starts and ends above the organ; goes 1 to 5 mm deep and up to 8 mm to all sides."""
    j = int(rng.choice(inner_positions(v)))
    normal = v.surface.normals[j]
    one, other = np.linalg.svd(normal[None])[2][1:]
    t = np.linspace(0.0, 2.0 * np.pi, n)[:, None]
    depth = -1.5e-3 + (1.5e-3 + rng.uniform(1e-3, 5e-3)) * np.sin(t / 2.0) ** 2
    a = rng.uniform(-8e-3, 8e-3, 4)
    x, y = a[0] * np.sin(t) + a[1] * np.sin(2 * t), a[2] * np.sin(t) + a[3] * np.sin(3 * t)
    return np.asarray(v.surface.centers[j] + (TIP - depth) * normal + x * one + y * other)


def least_dissipation(v: Vademecum, n_loops: int, n: int) -> float:
    """Smallest work lost on a loop, over the work that went to and fro."""
    model = prepare(v, (TIP,), cloud="off", effects=(Friction(0.3, 0.2),))
    rng, least = np.random.default_rng(0), np.inf
    for _ in range(n_loops):
        path = random_loop(v, rng, n)
        felt = forces(model, path)
        each = -(0.5 * (felt[1:] + felt[:-1]) * np.diff(path, axis=0)).sum(axis=1)
        if np.abs(each).sum() > 1e-6:
            least = min(least, each.sum() / np.abs(each).sum())
    return float(least)


def test_friction_takes_energy_on_every_loop(phantom_vademecum: Vademecum) -> None:
    assert least_dissipation(phantom_vademecum, 100, 150) > 0.0


@pytest.mark.long
def test_friction_takes_energy_on_ten_thousand_loops(phantom_vademecum: Vademecum) -> None:
    assert least_dissipation(phantom_vademecum, 10_000, 150) > 0.0


# --- Viscoelasticity ----------------------------------------------------------------------------

PRONY = Viscoelasticity((0.3, 0.2), (0.05, 0.7))


def relaxed_force(times: np.ndarray, depths: np.ndarray, t: float) -> float:
    """f(t) = int g(t - t') d(depth)/C for a motion that is linear between its corners."""
    g, tau = np.array(PRONY.g), np.array(PRONY.tau)
    force = 0.0
    for t0, t1, d0, d1 in zip(times[:-1], times[1:], depths[:-1], depths[1:], strict=True):
        end = min(t1, t)
        if end <= t0:
            break
        rate = (d1 - d0) / (t1 - t0) / COMPLIANCE
        decay = np.exp(-(t - end) / tau) - np.exp(-(t - t0) / tau)
        force += rate * ((1.0 - g.sum()) * (end - t0) + float(g * tau @ decay))
    return force


@pytest.mark.parametrize("period", [0.1e-3, 0.5e-3, 1e-3, 2e-3, 5e-3, 10e-3])
def test_relaxation_is_exact_for_motion_in_straight_lines(period: float) -> None:
    """Down, hold, further down, half back: the closed form to 1e-6 whatever the step."""
    times = np.array([0.0, 0.1, 0.5, 0.6, 0.9, 1.0])
    depths = 1e-3 * np.array([0.0, 3.0, 3.0, 4.0, 4.0, 2.0])
    model = flat_organ((PRONY,), period)
    worst, peak = 0.0, 0.0
    for k in range(1, round(1.0 / period) + 1):
        t = k * period
        step(model, at_depth(float(np.interp(t, times, depths))))
        exact = relaxed_force(times, depths, t)
        worst, peak = max(worst, abs(model.out.force[0, 2] - exact)), max(peak, exact)
    assert worst < 1e-6 * peak


RAMP = 0.02  # [s] in which the force of the creep test grows


def creep(t: float) -> float:
    """Depth over C f of the flat organ, t after the start of a ramp to a constant force.

    The compliance J(s) = 1 / (s^2 g(s)) of two Maxwell terms by partial fractions, integrated over
    the ramp.
    """
    (g0, g1), (tau0, tau1) = PRONY.g, PRONY.tau
    rest, p = 1.0 - g0 - g1, np.poly1d([1.0, 0.0])
    a, b = np.poly1d([tau0, 1.0]), np.poly1d([tau1, 1.0])
    numerator = a * b * rest + p * b * (g0 * tau0) + p * a * (g1 * tau1)
    value = 1.0 / rest
    for root in numerator.roots:
        part = (a * b)(root) / (root * numerator.deriv()(root))
        value += part * (np.exp(root * t) - np.exp(root * (t - RAMP))) / (root * RAMP)
    return float(value)


def crept(period: float, force: float, end: float) -> float:
    """Depth at the end of a force that grows in RAMP and stays, the tip moved to hold it."""
    model = flat_organ((PRONY,), period)
    depth = 0.0
    for k in range(1, round(end / period) + 1):
        wanted = force * min(1.0, k * period / RAMP)
        # the next step is affine in the depth: two trials, of which the memory knows nothing
        found = []
        for trial in (depth + 1e-3, depth + 2e-3):
            kept = [array.copy() for array in model.effects.memory]
            step(model, at_depth(trial))
            found.append(model.out.force[0, 2])
            for array, before in zip(model.effects.memory, kept, strict=True):
                array[...] = before
        depth += 1e-3 + 1e-3 * (wanted - found[0]) / (found[1] - found[0])
        step(model, at_depth(depth))
    return depth


def test_creep_under_a_held_force_is_of_second_order() -> None:
    """1e-3 at a tenth of the shortest relaxation time, and four times less at half of that."""
    end, force, shortest = 0.2, 5.0, min(PRONY.tau)
    exact = creep(end) * COMPLIANCE * force
    errors = [abs(crept(part * shortest, force, end) / exact - 1.0) for part in (0.2, 0.1, 0.05)]
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.15)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.15)


def test_tissue_comes_back_slowly_where_a_tool_has_been(phantom_vademecum: Vademecum) -> None:
    """The cloud keeps a dent after release, which fades with the relaxation times."""
    v = phantom_vademecum
    model = prepare(v, (TIP,), cloud="surface", effects=(Viscoelasticity((0.5,), (0.1,)),))
    path = push_and_drag(v)
    for _ in range(5):
        for tip in path:
            step(model, tip[None])
    deep = np.abs(model.out.cloud[:, 3:]).max()
    away = path[-1] + 50e-3 * v.surface.normals[middle_of_access(v)]
    dents = []
    for _ in range(3):
        step(model, away[None])
        dents.append(np.abs(model.out.cloud[:, 3:]).max())
        for _ in range(299):
            step(model, away[None])
    assert model.out.force[0].any() == False  # noqa: E712
    assert 0.1 * deep < dents[0] < deep
    assert dents[1] < 0.5 * dents[0]
    assert dents[2] < 0.5 * dents[1]


def test_fresh_tissue_is_stiffer_than_tissue_that_was_held(phantom_vademecum: Vademecum) -> None:
    """A long hold relaxes the force to the part that is left, 1 - sum g."""
    v = phantom_vademecum
    model = prepare(v, (TIP,), cloud="off", effects=(Viscoelasticity((0.4,), (0.02,)),))
    bare = prepare(v, (TIP,), cloud="off", effects=())
    tip = push_and_drag(v)[20]
    step(bare, tip[None])
    elastic = np.linalg.norm(bare.out.force[0])
    for _ in range(400):
        step(model, tip[None])
    assert np.linalg.norm(model.out.force[0]) == pytest.approx(0.6 * elastic, rel=1e-4)


# --- Inertia ------------------------------------------------------------------------------------


@BilinearForm
def density(u, v, w):  # type: ignore[no-untyped-def]
    return dot(u, v)


def elasticity_of(v: Vademecum) -> Elasticity:
    return Elasticity(v.mesh, v.material, v.regions.clamped, v.element)


def test_free_vibration_has_the_frequencies_of_the_whole_organ(
    phantom_vademecum: Vademecum,
) -> None:
    """The five slowest, against a sparse eigen-solve with a consistent mass of its own."""
    v, rho = phantom_vademecum, 1060.0
    elasticity = elasticity_of(v)
    mesh = MeshTet(v.mesh.vertices.T.copy(), v.mesh.tets.T.copy())
    shape = ElementTetP1() if v.element == "P1" else ElementTetP2()
    basis = Basis(mesh, ElementVector(shape), intorder=4)
    mass = density.assemble(basis).tocsr()
    # scikit-fem's numbering: vertices first as ours, then edges in its own order
    order = np.concatenate([basis.nodal_dofs.T.ravel(), basis.edge_dofs.T.ravel()])
    mass = rho * mass[order][:, order]
    free = np.ones((elasticity.n_nodes, 3), bool)
    free[elasticity.clamped_nodes] = False
    free = np.flatnonzero(free)
    stiffness = elasticity.stiffness[free][:, free].tocsc()
    value = sla.eigsh(stiffness, 5, mass[free][:, free], sigma=0.0, return_eigenvectors=False)
    _, modal = turned_modes(v, rho)
    np.testing.assert_allclose(1.0 / np.sqrt(modal[:5]), np.sqrt(np.sort(value)), rtol=0.01)


def swing_energy(model: ContactModel) -> float:
    swing = model.effects.inertia
    return kinetic_energy(swing) + 0.5 * float(swing.modes @ swing.modes)


def test_a_released_organ_swings_with_its_frequency_and_never_gains_energy(
    phantom_vademecum: Vademecum,
) -> None:
    v = phantom_vademecum
    model = prepare(v, (TIP,), cloud="off", effects=(Inertia(damping=0.01),))
    for tip in push_and_drag(v):
        step(model, tip[None])
    for _ in range(200):
        step(model, push_and_drag(v)[-1:])
    away = np.full((1, 3), 1e3)
    energy, slowest = [], []
    for _ in range(3000):
        step(model, away)
        energy.append(swing_energy(model))
        slowest.append(model.effects.inertia.modes[0])
    assert energy[0] > 1e-4
    assert (np.diff(energy) <= 1e-12 * energy[0]).all()
    slowest = np.array(slowest)
    crossings = np.flatnonzero((slowest[:-1] < 0.0) & (slowest[1:] >= 0.0))
    frequency = 1e3 * (len(crossings) - 1) / (crossings[-1] - crossings[0])
    expected = 1.0 / np.sqrt(model.effects.inertia.mass[0]) / (2.0 * np.pi)
    assert frequency == pytest.approx(expected, rel=0.01)


@pytest.mark.long
def test_energy_never_grows_in_a_minute_of_swinging(phantom_vademecum: Vademecum) -> None:
    """Without damping but the rule's own, and with a tip at rest that the organ strikes."""
    v = phantom_vademecum
    model = prepare(v, (TIP,), cloud="off", effects=(Inertia(damping=0.0),))
    path = push_and_drag(v)
    for tip in path:
        step(model, tip[None])
    rest = path[-1:] + 1e-3 * v.surface.normals[middle_of_access(v)]
    energy = []
    for k in range(60_000):
        step(model, rest if k < 30_000 else np.full((1, 3), 1e3))
        near = model.state.compliance[0, 0] - model.state.scale[0] ** 2 * float(
            model.effects.reply.gain @ model.state.mode[0].astype(float) ** 2
        )
        held = 0.5 * near * model.state.force[0] ** 2 if model.state.force[0] > 0.0 else 0.0
        energy.append(swing_energy(model) + held)
    energy = np.array(energy)
    assert (np.diff(energy) <= 1e-8 * energy[0]).all()  # single precision of the near field
    assert (energy[100:] - energy[:-100] <= 1e-9 * energy[0]).all()


def test_a_slow_push_does_not_feel_the_mass(phantom_vademecum: Vademecum) -> None:
    v = phantom_vademecum
    path = push_and_drag(v, 4000)
    bare = forces(prepare(v, (TIP,), cloud="off", effects=()), path)
    heavy = forces(prepare(v, (TIP,), cloud="off", effects=(Inertia(damping=1.0),)), path)
    np.testing.assert_allclose(heavy[-1], bare[-1], atol=0.02 * np.abs(bare).max())


# --- Gravity ------------------------------------------------------------------------------------


def full_sag(v: Vademecum, acceleration: np.ndarray, rho: float) -> np.ndarray:
    """Full finite elements under gravity, at all nodes (3 n_nodes,)."""
    elasticity = elasticity_of(v)
    mesh = MeshTet(v.mesh.vertices.T.copy(), v.mesh.tets.T.copy())
    shape = ElementTetP1() if v.element == "P1" else ElementTetP2()
    basis = Basis(mesh, ElementVector(shape), intorder=4)
    order = np.concatenate([basis.nodal_dofs.T.ravel(), basis.edge_dofs.T.ravel()])
    mass = rho * density.assemble(basis).tocsr()[order][:, order]
    load = mass @ np.tile(acceleration, elasticity.n_nodes)
    return np.asarray(elasticity.solve(load[:, None])[:, 0])


@pytest.mark.parametrize("down", [(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.3, -0.8, 0.5)])
def test_the_organ_sags_as_full_finite_elements_do(
    phantom_vademecum: Vademecum, down: tuple[float, float, float]
) -> None:
    """Within the certificate's mean error; in truth to single precision."""
    v = phantom_vademecum
    effect = SelfWeight(density=1060.0, gravity=9.81, direction=down)
    model = prepare(v, (TIP,), cloud="volume", effects=(effect,))
    step(model, np.full((1, 3), 1e3))
    unit = np.array(down) / np.linalg.norm(down)
    exact = full_sag(v, 9.81 * unit, 1060.0)[: 3 * len(v.mesh.vertices)].reshape(-1, 3)
    mass = v.mesh.vertex_volumes[:, None]
    error = np.sqrt((mass * (model.out.cloud[:, 3:] - exact) ** 2).sum() / (mass * exact**2).sum())
    assert v.certificate is not None
    assert error < min(v.certificate.l2_mean, 1e-3)
    assert np.abs(exact).max() > 1e-4


def test_a_tip_meets_the_organ_where_it_hangs(phantom_vademecum: Vademecum) -> None:
    """The patch under it has moved as full finite elements say, but for the smoothing of w(p)."""
    v = phantom_vademecum
    inner, elasticity = inner_positions(v), elasticity_of(v)
    sag = np.stack([full_sag(v, 9.81 * axis, 1060.0) for axis in np.eye(3)], axis=1)
    ratio = []
    for j in inner[:: max(1, len(inner) // 12)]:
        normal = v.surface.normals[j]
        model = prepare(v, (TIP,), cloud="off", effects=(SelfWeight(direction=tuple(normal)),))
        step(model, (v.surface.centers[j] + (TIP - 1e-3) * normal)[None])
        patch = patch_loads(elasticity, v.surface.centers[[j]], v.surface.patch_radius)
        exact = float(normal @ (patch.T @ (sag @ normal)))
        assert exact > 0.0
        ratio.append(model.effects.reply.lift[0] / exact)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.03)
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


# --- Respiration --------------------------------------------------------------------------------


def test_breathing_is_the_opposite_motion_of_the_tool(phantom_vademecum: Vademecum) -> None:
    v, n = phantom_vademecum, 400
    effect = Respiration(period=0.8, amplitude=8e-3, axis=(0.2, -1.0, 0.4), dwell=2)
    breathing = prepare(v, (TIP,), cloud="surface", effects=(effect,))
    still = prepare(v, (TIP,), cloud="surface", effects=())
    path = push_and_drag(v, n)
    t = 1e-3 * np.arange(1, n + 1)
    shift = (1.0 - np.cos(np.pi * t / 0.8) ** 4)[:, None] * 8e-3 * np.array(effect.axis)
    touched = 0
    for k in range(n):
        assert step(breathing, path[k : k + 1]) == step(still, path[k : k + 1] - shift[k])
        np.testing.assert_allclose(breathing.out.force, still.out.force, atol=1e-9)
        moved = breathing.out.cloud - still.out.cloud
        np.testing.assert_allclose(moved[:, :3], np.tile(shift[k], (len(moved), 1)), atol=1e-6)
        np.testing.assert_allclose(moved[:, 3:], 0.0, atol=1e-9)
        touched += int(breathing.out.n_contacts[0])
    assert touched > 50


# --- Several tools, and everything together -----------------------------------------------------


def test_two_tools_without_the_effect_are_refused(phantom_vademecum: Vademecum) -> None:
    with pytest.raises(SceneError, match="2 tools without several_tools"):
        prepare(phantom_vademecum, (TIP, TIP), effects=())


@pytest.mark.long
def test_everything_at_once_stays_sane(phantom_vademecum: Vademecum) -> None:
    """Two tools, all effects, ten seconds of touching: finite, bounded, and at rest in the end."""
    v = phantom_vademecum
    effects = tuple(effect for effect, _ in CHOICES.values())
    model = prepare(v, (TIP, TIP), cloud="surface", effects=effects)
    inner = inner_positions(v)
    rng = np.random.default_rng(0)
    peak = 0.0
    for _ in range(10):
        one, other = rng.choice(inner, 2, replace=False)
        for k in range(500):
            depth = 6e-3 * np.sin(np.pi * k / 500) ** 2 - 1e-3
            drag = 3e-3 * np.sin(4 * np.pi * k / 500)
            centers, normals = v.surface.centers[[one, other]], v.surface.normals[[one, other]]
            step(model, centers + (TIP - depth) * normals + drag * np.roll(normals, 1, axis=1))
            assert np.isfinite(model.out.force).all()
            assert np.isfinite(model.out.cloud).all()
            peak = max(peak, float(np.abs(model.out.force).max()))
    assert 0.5 < peak < 100.0
    for _ in range(20_000):
        step(model, np.full((2, 3), 1e3))
    memory = model.effects.memory
    assert np.abs(memory.past).max() < 1e-3 * peak
    assert memory.count[0] == 0 or np.abs(memory.trail_elastic[: memory.count[0]]).max() < 1e-3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Friction(static=-0.1, kinetic=-0.2),
            "friction.static is -0.1; it must lie in 0 to 1",
        ),
        (lambda: Friction(0.2, 0.3), "kinetic is 0.3, above static 0.2"),
        (
            lambda: Viscoelasticity((0.3,), (0.0,)),
            "viscoelasticity.tau is 0.0; it must lie",
        ),
        (lambda: Viscoelasticity((-0.3,), (1.0,)), "viscoelasticity.g is -0.3"),
        (lambda: Viscoelasticity((0.6, 0.5), (1.0, 2.0)), "sum of g is 1.1"),
        (lambda: Viscoelasticity((0.3,), (1.0, 2.0)), "1 g and 2 tau"),
        (lambda: Inertia(density=0.0), "inertia.density is 0.0"),
        (lambda: SelfWeight(direction=(0.0, 0.0, 0.0)), "not all zero"),
        (lambda: Respiration(period=float("nan")), "respiration.period is nan"),
    ],
)
def test_numbers_out_of_range_are_refused_in_one_line(make, message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(SceneError) as refusal:
        make()
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_vademecum_without_the_organs_mass_says_what_builds_one(
    phantom_vademecum: Vademecum,
) -> None:
    old = replace(phantom_vademecum, body=None)
    for effect in (SelfWeight(), Inertia()):
        with pytest.raises(SceneError, match="avatar vademecum"):
            prepare(old, (TIP,), effects=(effect,))
