"""Contact: action and reaction, energy, smoothness, exact constraints, every status."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from avatar_core.contact.model import (
    ContactModel,
    Status,
    deform,
    prepare,
    solve,
    step,
    stored_energy,
)
from avatar_core.contact.tip_response import closest_weights
from avatar_core.contact.tool_path import inner_positions, middle_of_access, palpation, slide
from avatar_core.errors import ContactError
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.model import Vademecum

RADIUS = 5e-3
SPHERE, PATCH = Tip("sphere", RADIUS), Tip("patch", RADIUS)


@pytest.fixture()
def model(phantom_vademecum: Vademecum) -> ContactModel:
    return prepare(phantom_vademecum, (SPHERE,), cloud="volume")


@pytest.fixture()
def patch(phantom_vademecum: Vademecum) -> ContactModel:
    """The load that a vademecum was computed for, and its certificate is about."""
    return prepare(phantom_vademecum, (PATCH,), cloud="volume")


def push(v: Vademecum, depth: float, position: int | None = None) -> np.ndarray:
    j = middle_of_access(v) if position is None else position
    return (v.surface.centers[j] + (RADIUS - depth) * v.surface.normals[j])[None].copy()


def test_no_force_without_contact(phantom_vademecum: Vademecum, model: ContactModel) -> None:
    assert step(model, push(phantom_vademecum, -1e-3)) == Status.OK
    assert not model.out.force.any()
    assert model.out.n_contacts[0] == 0
    np.testing.assert_array_equal(model.out.cloud[:, 3:], 0.0)


def test_force_of_a_patch_equals_full_finite_elements(
    phantom_vademecum: Vademecum, patch: ContactModel
) -> None:
    """lambda = indentation / (n . C n), C from fresh solves, as well as the certificate says."""
    from avatar_core.fem.elasticity import Elasticity
    from avatar_core.fem.patch_loads import patch_loads, patch_normals

    v = phantom_vademecum
    problem = Elasticity(v.mesh, v.material, v.regions.clamped)
    errors = []
    for j in np.random.default_rng(3).choice(inner_positions(v), 8, replace=False):
        patch.reset()
        assert step(patch, push(v, 3e-3, j)) == Status.OK
        s = patch.state.point
        n = patch_normals(v.mesh, s, v.surface.patch_radius)[0]
        load = patch_loads(problem, s, v.surface.patch_radius)
        compliance = n @ (load.T @ problem.solve(load)) @ n
        errors.append(abs(patch.state.force[0] * compliance / -patch.state.gap[0] - 1.0))
    assert v.certificate is not None
    assert np.mean(errors) < 2.0 * v.certificate.tip_force_mean
    assert np.max(errors) < 1.5 * v.certificate.tip_force_worst


def test_patch_does_not_penetrate(phantom_vademecum: Vademecum, model: ContactModel) -> None:
    for tip in slide(phantom_vademecum, RADIUS, 4e-3, 0.02):
        assert step(model, tip[None].copy()) == Status.OK
        assert model.out.contact_penetration[0] < 1e-5


def test_action_is_reaction(phantom_vademecum: Vademecum, patch: ContactModel) -> None:
    """The organ is displaced by the opposite of the normal force on the tool."""
    v = phantom_vademecum
    step(patch, push(v, 5e-3))
    n, force = patch.state.normal[0], patch.out.force[0]
    # the rest is tangential: towards softer tissue
    assert force @ n == pytest.approx(patch.state.force[0], rel=0.02)
    # the load on the organ is scaled so that its patch moves by the indentation
    scale = patch.state.scale[0]
    assert scale == pytest.approx(1.0, abs=0.05)
    load = -n * patch.state.force[0] * scale
    cloud = patch.out.cloud[:, 3:].ravel()
    # the step's own weights; its near field leaves out those below 2 %
    field = v.displacement(*carriers(patch)) @ load
    assert np.linalg.norm(cloud - field) < 0.005 * np.linalg.norm(field)
    np.testing.assert_allclose(cloud, field, atol=0.05 * np.abs(field).max())
    # the surface point below: the tip's weights are blurred over 1.5 mm around it
    field = v.displacement(*at_closest_point(v, patch)) @ load
    assert np.linalg.norm(cloud - field) < 0.01 * np.linalg.norm(field)


def carriers(model: ContactModel) -> tuple[np.ndarray, np.ndarray]:
    """Load positions that carry the first tip, and their weights."""
    n = model.state.n_nodes[0]
    return model.state.nodes[0, :n], model.state.weight[0, :n, 0]


def at_closest_point(v: Vademecum, model: ContactModel) -> tuple[np.ndarray, np.ndarray]:
    """Load positions and weights at the surface point below the first tip."""
    positions, weights = closest_weights(v.surface, model.state.point[:1])
    return positions[0], weights[0]


def test_displacement_moves_the_cloud(phantom_vademecum: Vademecum, model: ContactModel) -> None:
    step(model, push(phantom_vademecum, 5e-3))
    moved = phantom_vademecum.mesh.vertices + model.out.cloud[:, 3:]
    np.testing.assert_allclose(model.out.cloud[:, :3], moved, atol=1e-7)


def test_force_is_the_derivative_of_the_energy(
    phantom_vademecum: Vademecum, model: ContactModel
) -> None:
    v = phantom_vademecum
    rng = np.random.default_rng(2)
    for j in rng.choice(inner_positions(v), 5):
        tip = push(v, 4e-3, j) + rng.uniform(-2e-3, 2e-3, 3)
        step(model, tip)
        force = model.out.force[0].copy()
        slope = energy_slope(model, tip)
        np.testing.assert_allclose(force, -slope, atol=1e-3 * np.linalg.norm(force))


def energy_slope(model: ContactModel, tip: np.ndarray, h: float = 1e-5) -> np.ndarray:
    """Gradient of the stored energy by the place of a tip, central differences [N]."""
    energy = []
    for moved in np.concatenate([tip + h * np.eye(3), tip - h * np.eye(3)]):
        step(model, moved[None].copy())
        energy.append(stored_energy(model))
    return (np.array(energy[:3]) - np.array(energy[3:])) / (2.0 * h)


@pytest.mark.long
@pytest.mark.parametrize("depth", [2e-3, 5e-3])
def test_sliding_force_on_real_livers_has_no_steps(real_vademecum: Vademecum, depth: float) -> None:
    """99 % change by less than 2 % of the peak per 0.1 mm, besides turning as the surface does.

    Facets meet at edges, over which the normal turns by up to 0.05 a step and the force with it. A
    slope, walked ten times finer, changes by a tenth per step; a step by all of it.
    """
    v, model = real_vademecum, prepare(real_vademecum, (SPHERE,))
    others = np.random.default_rng(3).choice(inner_positions(v, 20e-3), 4, replace=False)
    slides = [force_steps(v, model, depth, j) for j in (None, *others)]
    size, coarse, fine, peak = (np.array(values) for values in zip(*slides, strict=True))
    print(
        f"{v.name}: largest force step {coarse.max():.2%} of the peak per 0.1 mm, 99 % within "
        f"{np.quantile(coarse, 0.99):.2%}, in size {np.quantile(size, 0.99):.2%}; "
        f"{fine.max():.2%} per 0.01 mm"
    )
    assert (peak > 0.3).all()
    assert np.quantile(size, 0.99) < 0.02
    steepest = np.maximum(coarse.max(axis=1), 0.02)
    assert (fine.max(axis=1) < steepest / 4).all()


@pytest.mark.long
def test_a_tip_may_press_at_every_inner_position(real_vademecum: Vademecum) -> None:
    """5 mm deep, straight in along the normal of the undeformed surface."""
    v, model = real_vademecum, prepare(real_vademecum, (SPHERE,))
    refused = []
    for j in inner_positions(v, 20e-3):
        model.reset()
        tip = slide(v, RADIUS, 5e-3, 1e-4, position=j)
        if step(model, tip) != Status.OK:
            refused.append(j)
    assert not refused


def force_steps(
    v: Vademecum, model: ContactModel, depth: float, position: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Force steps over 200 mm at constant depth, 0.1 mm each, in size alone and in all; and 0.01
    mm where it changes most.

    All as part of the peak, and the peak [N].
    """
    path = slide(v, RADIUS, depth, 0.2, position=position)
    forces = forces_along(model, path)
    size = np.linalg.norm(forces, axis=1)
    peak = size.max()
    steps = np.linalg.norm(np.diff(forces, axis=0), axis=1) / peak
    k = int(steps.argmax())
    fine = forces_along(model, np.concatenate([path[:k], refined(path[k : k + 2], 10)]))[k:]
    finer = np.linalg.norm(np.diff(fine, axis=0), axis=1) / peak
    return np.abs(np.diff(size)) / peak, steps, finer, float(peak)


def forces_along(model: ContactModel, path: np.ndarray) -> np.ndarray:
    """Force on a tip that goes along a path, without a step that fails, shape (n, 3) [N]."""
    model.reset()
    forces = np.empty_like(path)
    for k, tip in enumerate(path):
        assert step(model, tip[None].copy()) == Status.OK
        forces[k] = model.out.force[0]
    return forces


def refined(path: np.ndarray, n: int) -> np.ndarray:
    """Every leg of a path in n steps."""
    legs = [np.linspace(a, b, n, endpoint=False) for a, b in pairwise(path)]
    return np.concatenate([*legs, path[-1:]])


@pytest.mark.parametrize("depth", [1e-3, 5e-3])
def test_sliding_force_has_no_steps(
    phantom_vademecum: Vademecum, model: ContactModel, depth: float
) -> None:
    """200 mm at constant depth in steps of 0.1 mm: no step above 2 % of the peak force."""
    _, coarse, fine, peak = force_steps(phantom_vademecum, model, depth)
    assert peak > 0.3  # a sphere on a half-space: 0.6 and 7 N
    assert coarse.max() < 0.02
    assert fine.max() < 0.02 / 4


def test_small_tip_is_felt_between_vertices(phantom_vademecum: Vademecum) -> None:
    """A 2 mm tip over face centroids: as much force as over the vertices around."""
    v = phantom_vademecum
    small = prepare(v, (Tip("sphere", 2e-3),))
    inner = set(inner_positions(v).tolist())
    for corners in v.surface.corners[::15]:
        if not inner.issuperset(corners.tolist()):
            continue
        centroid = v.surface.centers[corners].mean(axis=0)
        normal = v.surface.normals[corners].mean(axis=0)
        step(small, (centroid + normal * 0.5e-3)[None].copy())
        assert np.linalg.norm(small.out.force[0]) > 0.1


def test_two_tools_share_the_organ(phantom_vademecum: Vademecum) -> None:
    """With a second tool pressing beside, the organ has sunk and the first force is smaller."""
    v = phantom_vademecum
    two = prepare(v, (SPHERE,) * 2)
    a = middle_of_access(v)
    inner = inner_positions(v)
    distance = np.linalg.norm(v.surface.centers[inner] - v.surface.centers[a], axis=1)
    b = int(inner[np.argmin(abs(distance - 25e-3))])
    tips = np.concatenate([push(v, 4e-3, a), push(v, 4e-3, b)])
    lifted = np.concatenate([push(v, 4e-3, a), push(v, -4e-3, b)])
    step(two, lifted)
    alone = np.linalg.norm(two.out.force[0])
    step(two, tips)
    assert two.out.n_contacts[0] == 2
    assert 0.3 * alone < np.linalg.norm(two.out.force[0]) < 0.98 * alone
    assert (two.out.contact_penetration[:2] < 1e-5).all()


@pytest.mark.parametrize("distance", [16e-3, 30e-3, 60e-3])
def test_coupled_forces_are_the_derivative_of_the_energy(
    phantom_vademecum: Vademecum, distance: float
) -> None:
    v = phantom_vademecum
    two = prepare(v, (SPHERE,) * 2)
    a, inner = middle_of_access(v), inner_positions(v)
    apart = np.linalg.norm(v.surface.centers[inner] - v.surface.centers[a], axis=1)
    b = int(inner[np.argmin(abs(apart - distance))])
    tips = np.concatenate([push(v, 4e-3, a), push(v, 4e-3, b)]) + 1e-4
    step(two, tips)
    assert two.out.n_contacts[0] == 2
    force, slope, h = two.out.force.copy(), np.empty((2, 3)), 1e-5
    for t, d in np.ndindex(2, 3):
        energies = []
        for sign in (1, -1):
            moved = tips.copy()
            moved[t, d] += sign * h
            step(two, moved)
            energies.append(stored_energy(two))
        slope[t, d] = (energies[0] - energies[1]) / (2 * h)
    np.testing.assert_allclose(force, -slope, atol=1e-3 * np.abs(force).max())


def test_compliance_between_tips_is_symmetric_positive_definite(
    phantom_vademecum: Vademecum,
) -> None:
    smallest, asymmetry = active_set_spectrum(phantom_vademecum, 200, seed=0)
    assert smallest > 0
    assert asymmetry < 1e-6


@pytest.mark.long
def test_compliance_between_tips_on_real_livers(real_vademecum: Vademecum) -> None:
    smallest, asymmetry = active_set_spectrum(real_vademecum, 300, seed=1)
    print(f"{real_vademecum.name}: smallest eigenvalue {smallest:.2e} of the mean diagonal")
    assert smallest > 0
    assert asymmetry < 1e-6


def active_set_spectrum(v: Vademecum, n_sets: int, seed: int) -> tuple[float, float]:
    """Of 2 to 8 tips at random: least eigenvalue and largest asymmetry over the mean diagonal."""
    rng = np.random.default_rng(seed)
    model = prepare(v, (SPHERE,) * 8, cloud="off")
    faces = v.surface.corners
    smallest, asymmetry, seen = np.inf, 0.0, 0
    for _ in range(n_sets):
        chosen = faces[rng.choice(len(faces), 8, replace=False)]
        share = rng.dirichlet(np.ones(3), 8)
        points = np.einsum("ck,ckd->cd", share, v.surface.centers[chosen])
        normals = np.einsum("ck,ckd->cd", share, v.surface.normals[chosen])
        tips = points + (RADIUS - 2e-3) * normals
        tips[rng.integers(2, 9) :] += 1.0  # the others are out of contact
        model.reset()
        step(model, tips)
        pressed = np.flatnonzero(model.state.active)
        if len(pressed) < 2:
            continue
        seen += 1
        c = model.state.compliance[np.ix_(pressed, pressed)]
        scale = np.diag(c).mean()
        smallest = min(smallest, np.linalg.eigvalsh((c + c.T) / 2).min() / scale)
        asymmetry = max(asymmetry, np.abs(c - c.T).max() / scale)
    assert seen > 0.9 * n_sets
    return smallest, asymmetry


def test_force_of_a_patch_is_proportional_to_its_depth(
    phantom_vademecum: Vademecum, patch: ContactModel
) -> None:
    """Linear elasticity: lambda / (-gap) does not depend on depth at one surface point."""
    v = phantom_vademecum
    ratio = []
    for depth in (0.5e-3, 1e-3, 2e-3):
        step(patch, push(v, depth))
        ratio.append(patch.state.force[0] / -patch.state.gap[0])
    np.testing.assert_allclose(ratio, ratio[0], rtol=5e-3)  # s moves with the tip by < 0.1 mm


def test_return_to_rest_is_exact(phantom_vademecum: Vademecum, model: ContactModel) -> None:
    v = phantom_vademecum
    for tip in palpation(v, RADIUS, 8e-3, 200):
        step(model, tip[None].copy())
    assert not model.out.force.any()
    np.testing.assert_array_equal(model.out.cloud[:, 3:], 0.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_invalid_pose_has_no_force(
    phantom_vademecum: Vademecum, model: ContactModel, bad: float
) -> None:
    step(model, push(phantom_vademecum, 3e-3))
    assert step(model, np.array([[bad, 0.0, 0.0]])) == Status.INVALID_POSE
    assert not model.out.force.any()
    assert step(model, push(phantom_vademecum, -3e-3)) == Status.OK


def test_tip_that_starts_inside_is_out_of_range_until_withdrawn(
    phantom_vademecum: Vademecum, model: ContactModel
) -> None:
    deep = push(phantom_vademecum, RADIUS + 12e-3)
    assert step(model, deep) == Status.OUT_OF_RANGE
    for depth in np.arange(RADIUS + 12e-3, 0.0, -1e-3):  # it gives no energy back on its way out
        assert step(model, push(phantom_vademecum, depth)) == Status.OUT_OF_RANGE
        assert not model.out.force.any()
    step(model, push(phantom_vademecum, -1e-3))
    for depth in np.arange(0.0, RADIUS + 12e-3, 1e-3):
        step(model, push(phantom_vademecum, depth))
    assert step(model, deep) == Status.OK
    assert model.out.force.any()


def test_clamped_side_is_out_of_range(phantom_vademecum: Vademecum, model: ContactModel) -> None:
    v = phantom_vademecum
    away = v.mesh.vertices[v.mesh.surface_vertices]
    back = away[np.argmin(away[:, 1])] + np.array([0.0, -1e-3, 0.0])
    assert step(model, back[None].copy()) in (Status.OK, Status.OUT_OF_RANGE)
    assert not model.out.force.any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tips": ()}, "tools"),
        ({"tips": (SPHERE, PATCH)}, "all tools tips, or all patches"),
        ({"modes": 0}, "modes"),
        ({"modes": 10**6}, "modes"),
        ({"cloud": "fog"}, "cloud"),
    ],
)
def test_impossible_model_is_refused(
    phantom_vademecum: Vademecum, options: dict[str, object], message: str
) -> None:
    with pytest.raises(ContactError, match=message):
        prepare(phantom_vademecum, **options)  # type: ignore[arg-type]


def test_each_tool_has_its_own_status(phantom_vademecum: Vademecum) -> None:
    two = prepare(phantom_vademecum, (SPHERE,) * 2)
    tips = np.concatenate([push(phantom_vademecum, 3e-3), [[np.nan, 0.0, 0.0]]])
    assert step(two, tips) == Status.INVALID_POSE
    assert two.out.status.tolist() == [Status.OK, Status.INVALID_POSE]
    assert two.out.force[0].any() and not two.out.force[1].any()


def test_solve_then_deform_is_a_step(phantom_vademecum: Vademecum, model: ContactModel) -> None:
    tip = push(phantom_vademecum, 4e-3)
    step(model, tip)
    halves = prepare(phantom_vademecum, (SPHERE,), cloud="volume", halves=True)
    halves.out.cloud[:] = 0.0
    assert solve(halves, tip) == Status.OK
    np.testing.assert_allclose(halves.out.force, model.out.force, rtol=1e-14)
    assert not halves.out.cloud.any()
    deform(halves)
    # one bit at 0.2 m
    np.testing.assert_allclose(halves.out.cloud, model.out.cloud, rtol=0, atol=2e-8)


def test_the_step_cannot_allocate() -> None:
    """Whoever writes an array into it is told when it compiles."""
    import numba

    from avatar_core.common.jit import entry

    @entry
    def careless(n):  # type: ignore[no-untyped-def]
        return np.zeros(n)[0]

    with pytest.raises(numba.core.errors.TypingError, match="Only accept"):
        careless(3)
