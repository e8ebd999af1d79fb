"""A step against full finite elements, along slides, and where it is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from avatar_core.contact.locate import ENTRY_DEPTH
from avatar_core.contact.model import ContactData, Status
from avatar_core.contact.organ_response import closest_weights
from avatar_core.contact.tool_path import inner_positions, middle_of_access, slide
from avatar_core.errors import ContactError
from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.patch_loads import patch_loads, patch_normals
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.model import Vademecum
from tests.helpers.contact import deform, prepare, solve, step
from tests.helpers.examples import examples
from tests.helpers.flat_organ import BALL, COMPLIANCE, flat_organ
from tests.helpers.tool_motion import follow, load_positions, refined

RADIUS = 5e-3
SPHERE, PATCH = Tip("sphere", RADIUS), Tip("patch", RADIUS)


def at_depth(v: Vademecum, depth: float, position: int | None = None) -> np.ndarray:
    j = middle_of_access(v) if position is None else position
    return (v.surface.centers[j] + (RADIUS - depth) * v.surface.normals[j])[None].copy()


# --- A patch: the load that a vademecum is computed for -------------------------------------------


def test_force_of_a_patch_equals_full_finite_elements(phantom_vademecum: Vademecum) -> None:
    """lambda = indentation / (n . C n) with C from fresh solves, within the certified error."""
    v, patch = phantom_vademecum, prepare(phantom_vademecum, (PATCH,), cloud="volume")
    problem = Elasticity(v.mesh, v.material, v.regions.clamped)
    errors = []
    for j in np.random.default_rng(3).choice(inner_positions(v), 8, replace=False):
        patch.reset()
        assert step(patch, at_depth(v, 3e-3, j)) == Status.OK
        s = patch.state.point
        n = patch_normals(v.mesh, s, v.surface.patch_radius)[0]
        load = patch_loads(problem, s, v.surface.patch_radius)
        compliance = n @ (load.T @ problem.solve(load)) @ n
        errors.append(abs(patch.state.force[0] * compliance / -patch.state.gap[0] - 1.0))
    assert v.certificate is not None
    assert np.mean(errors) < 2.0 * v.certificate.tip_force_mean
    assert np.max(errors) < 1.5 * v.certificate.tip_force_worst


def test_action_is_reaction(phantom_vademecum: Vademecum) -> None:
    """The organ is displaced by the opposite of the normal force on the tool."""
    v, patch = phantom_vademecum, prepare(phantom_vademecum, (PATCH,), cloud="volume")
    step(patch, at_depth(v, 5e-3))
    n, force = patch.state.normal[0], patch.out.force[0]
    # the rest is tangential: towards softer tissue
    assert force @ n == pytest.approx(patch.state.force[0], rel=0.02)
    load = -n * patch.state.force[0]
    moved = patch.out.cloud[:, 3:].ravel()
    # the step's own weights; its near field leaves out those below 2 %
    field = v.displacement(*load_positions(patch)) @ load
    assert np.linalg.norm(moved - field) < 0.005 * np.linalg.norm(field)
    np.testing.assert_allclose(moved, field, atol=0.05 * np.abs(field).max())
    # the surface point below: the tip's weights are blurred over 1.5 mm around it
    positions, weights = closest_weights(v.surface, patch.state.point[:1])
    field = v.displacement(positions[0], weights[0]) @ load
    assert np.linalg.norm(moved - field) < 0.01 * np.linalg.norm(field)


@examples(40)
@given(
    direction=st.tuples(*3 * [st.floats(-1.0, 1.0)]),
    depth=st.floats(0.1e-3, 10e-3),
    radius=st.floats(2e-3, 16e-3),  # the grid ends 56 mm from the middle
)
def test_force_of_a_ball_points_out_of_it_whatever_the_radius(
    direction: tuple[float, float, float], depth: float, radius: float
) -> None:
    assume(np.linalg.norm(direction) > 0.1 and depth - radius < ENTRY_DEPTH - 5e-4)
    n = np.array(direction) / np.linalg.norm(direction)
    data = flat_organ(tip=Tip("patch", radius), is_ball=True)
    assert step(data, ((BALL + radius - depth) * n)[None]) == Status.OK
    force = data.out.force[0]
    # the ball's distance is sampled every 3 mm: splines add h^2 / 8 of its curvature 2 / R
    spline = (3e-3) ** 2 / 8.0 * 2.0 / (BALL + radius - depth)
    assert abs(force @ n * COMPLIANCE - depth) < 1.5 * spline + 1e-2 * depth
    assert np.linalg.norm(force - (force @ n) * n) < 0.02 * np.linalg.norm(force)


# --- A sphere that slides -------------------------------------------------------------------------


def force_steps(
    v: Vademecum, data: ContactData, depth: float, position: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return force changes per 0.1 mm over 200 mm at constant depth, in size and as vectors.

    They are followed by the changes per 0.01 mm at the largest one. All are relative to the peak;
    the last value is the peak [N].
    """
    path = slide(v, RADIUS, depth, 0.2, position=position)
    forces = forces_along(data, path)
    size = np.linalg.norm(forces, axis=1)
    peak = size.max()
    steps = np.linalg.norm(np.diff(forces, axis=0), axis=1) / peak
    k = int(steps.argmax())
    fine = forces_along(data, np.concatenate([path[:k], refined(path[k : k + 2], 10)]))[k:]
    finer = np.linalg.norm(np.diff(fine, axis=0), axis=1) / peak
    return np.abs(np.diff(size)) / peak, steps, finer, float(peak)


def forces_along(data: ContactData, path: np.ndarray) -> np.ndarray:
    """Return the force on a tip along a path, without a failed step, shape (n, 3) [N]."""
    data.reset()
    motion = follow(data, path[:, None])
    assert (motion.status == Status.OK).all()
    return motion.force[:, 0]


@pytest.mark.parametrize("depth", [1e-3, 5e-3])
def test_sliding_force_has_no_steps(phantom_vademecum: Vademecum, depth: float) -> None:
    """200 mm at constant depth in steps of 0.1 mm: no step above 2 % of the peak force."""
    data = prepare(phantom_vademecum, (SPHERE,), cloud="volume")
    _, coarse, fine, peak = force_steps(phantom_vademecum, data, depth)
    assert peak > 0.3  # a sphere on a half-space: 0.6 and 7 N
    assert coarse.max() < 0.02
    assert fine.max() < 0.02 / 4


@pytest.mark.long
@pytest.mark.parametrize("depth", [2e-3, 5e-3])
def test_sliding_force_on_real_livers_has_no_steps(real_vademecum: Vademecum, depth: float) -> None:
    """99 % change by less than 2 % of the peak per 0.1 mm, besides turning with the surface.

    Facets meet at edges, over which the normal turns by up to 0.05 per step, and the force with it.
    On a path ten times finer, a slope changes by a tenth per step, but a discontinuity by all of
    it.
    """
    v, data = real_vademecum, prepare(real_vademecum, (SPHERE,))
    others = np.random.default_rng(3).choice(inner_positions(v, 20e-3), 4, replace=False)
    slides = [force_steps(v, data, depth, j) for j in (None, *others)]
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
    v, data = real_vademecum, prepare(real_vademecum, (SPHERE,))
    refused = []
    for j in inner_positions(v, 20e-3):
        data.reset()
        tip = slide(v, RADIUS, 5e-3, 1e-4, position=j)
        if step(data, tip) != Status.OK:
            refused.append(j)
    assert not refused


# --- Refusals, force before cloud, allocation -----------------------------------------------------


def test_clamped_side_is_out_of_range(phantom_vademecum: Vademecum) -> None:
    v, data = phantom_vademecum, prepare(phantom_vademecum, (SPHERE,), cloud="volume")
    vertices = v.mesh.vertices[v.mesh.surface_vertices]
    back = vertices[np.argmin(vertices[:, 1])] + np.array([0.0, -1e-3, 0.0])
    assert step(data, back[None].copy()) in (Status.OK, Status.OUT_OF_RANGE)
    assert not data.out.force.any()


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


def test_forces_come_before_the_cloud(phantom_vademecum: Vademecum) -> None:
    tip, data = at_depth(phantom_vademecum, 4e-3), prepare(phantom_vademecum, cloud="volume")
    step(data, tip)
    force, cloud = data.out.force.copy(), data.out.cloud.copy()
    data.reset()
    data.out.cloud[:] = 0.0
    assert solve(data, tip) == Status.OK
    assert np.array_equal(data.out.force, force) and not data.out.cloud.any()
    deform(data)
    assert np.array_equal(data.out.cloud, cloud)


def test_the_step_cannot_allocate() -> None:
    """Code that writes an array into it fails to compile."""
    import numba

    from avatar_core.common.jit import entry

    @entry
    def careless(n):  # type: ignore[no-untyped-def]
        return np.zeros(n)[0]

    with pytest.raises(numba.core.errors.TypingError, match="Only accept"):
        careless(3)
