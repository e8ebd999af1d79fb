"""Level sets on grids: handles, several bodies, the border of the grid, and all real livers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given
from hypothesis import strategies as st

from avatar_core.errors import SurfaceError
from avatar_core.geometry.level_set import (
    DistanceGrid,
    GridBox,
    distance_grid,
    distance_in_box,
    isosurface,
    reinitialize,
    signed_distance,
)
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from tests.helpers.examples import examples
from tests.helpers.known_surfaces import (
    RADIUS,
    ball,
    ball_volume,
    bodies_and_handles,
    gradient_length,
    inside_out,
    joined,
    refusal,
    signed_volume,
    steepest,
    torus,
    written,
)

# figures are only added to
few = examples(5, suppress_health_check=[HealthCheck.function_scoped_fixture])
fractions = st.tuples(*3 * [st.floats(0, 1)])  # of a cell: where the grid lies


def box_around(surface: SurfaceMesh, spacing: float, shift: tuple[float, float, float]) -> GridBox:
    """A box with room of two to three cells, displaced by fractions of a cell."""
    low, high = surface.bounding_box
    x, y, z = low - spacing * (2 + np.array(shift))
    nx, ny, nz = (int(n) for n in np.ceil((high - low) / spacing) + 6)
    return GridBox((x, y, z), spacing, (nx, ny, nz))


# --- 6. a handle ------------------------------------------------------------------------------


@few
@given(tube=st.floats(0.012, 0.035), shift=fractions)
@example(tube=0.035, shift=(0.5, 0.5, 0.5))
@example(tube=0.03164487096685557, shift=(0.0, 0.595703125, 0.861328125))
def test_a_handle_stays_a_handle(figure, tube, shift):
    spacing, surface = 5e-3, torus(0.045, tube)
    box = box_around(surface, spacing, shift)
    grid = distance_in_box(surface, box, band=2 * spacing)
    zero = isosurface(grid)
    assert bodies_and_handles(zero) == (1, 1)
    # second order in cells a curvature radius: that of the tube or of the opening
    tightest = min(tube, 0.045 - tube)
    error = grid.volume / signed_volume(surface) - 1
    assert abs(error) < 0.25 * (spacing / tube) ** 2
    ring = np.hypot(grid.points[:, 0], grid.points[:, 1]) - 0.045
    exact = np.hypot(ring, grid.points[:, 2]) - tube
    # 48 facets about the tube, 96 about the axis: they lie inside by at most both sagittas
    depth = tube * (1 - np.cos(np.pi / 48)) + (0.045 + tube) * (1 - np.cos(np.pi / 96))
    clear = np.abs(exact) > depth
    assert np.array_equal(grid.values.ravel()[clear] < 0, exact[clear] < 0)
    again = isosurface(reinitialize(grid))
    assert bodies_and_handles(again) == (1, 1)
    if tube == 0.035:
        figure(f"genus 1, opening of {2 * tightest / spacing:.0f} cells, volume {error:+.2%}")


# --- 7. two bodies ----------------------------------------------------------------------------


@few
@given(gap=st.floats(1.5, 6.0), shift=fractions, turned=st.booleans())
@example(gap=2.0, shift=(0.0, 0.0, 0.0), turned=False)
@example(gap=2.0, shift=(0.0, 0.0, 0.0), turned=True)
def test_two_bodies_stay_two(figure, tmp_path_factory, gap, shift, turned):
    spacing, small = 4e-3, 0.03
    centre = np.array([RADIUS + small + gap * spacing, 0, 0])
    other = ball(small, centre, level=3)
    both = joined(ball(level=3), inside_out(other) if turned else other)
    folder = tmp_path_factory.mktemp("two")
    assert "two separate bodies" in refusal(both, folder)
    surface = read_surface(written(folder, both), one_body=False)  # as tumours are read
    grid = distance_in_box(surface, box_around(both, spacing, shift))
    assert bodies_and_handles(isosurface(grid)) == (2, 0)
    true = ball_volume() + ball_volume(small)
    error = grid.volume / true - 1
    assert abs(error) < 3e-3
    away = np.linalg.norm(grid.points - centre, axis=1) - small
    exact = np.minimum(np.linalg.norm(grid.points, axis=1) - RADIUS, away)
    clear = np.abs(exact) > 5e-4
    assert np.array_equal(grid.values.ravel()[clear] < 0, exact[clear] < 0)
    assert steepest(grid) < 1 + 1e-9
    if shift == (0.0, 0.0, 0.0):
        figure(f"volume {error:+.2%}" + (", one inside out" if turned else ""))


# --- 8. the border of the grid ----------------------------------------------------------------


@pytest.mark.long
@few
@given(height=st.floats(-0.9, 1.0), axis=st.integers(0, 2), low=st.booleans())
@example(height=0.5, axis=2, low=True)
@example(height=1.0, axis=0, low=True)  # touches
@example(height=0.0, axis=1, low=False)
def test_what_leaves_the_grid_is_cut_off_at_its_border(figure, height, axis, low):
    """A side of the grid at height R from the ball's centre: a segment beyond is cut off."""
    spacing, surface = 3e-3, ball()
    n = 47
    origin = np.full(3, -(n - 1) / 2 * spacing)
    origin[axis] = -height * RADIUS if low else height * RADIUS - (n - 1) * spacing
    x, y, z = (float(value) for value in origin)
    grid = distance_in_box(surface, GridBox((x, y, z), spacing, (n, n, n)))
    zero = isosurface(grid)
    beyond = np.pi * RADIUS**3 * (2 / 3 - height + height**3 / 3)
    true = ball_volume() - beyond
    # the cut is exact, the sphere second order in cells a radius of the cap
    tolerance = 1.5 * (spacing / RADIUS) ** 2 * ball_volume()
    assert abs(grid.volume - true) < tolerance
    assert abs(signed_volume(zero) - true) < tolerance
    assert zero.is_watertight
    assert bodies_and_handles(zero)[0] == 1
    side = origin[axis] if low else origin[axis] + (n - 1) * spacing
    edge = zero.bounding_box[0 if low else 1][axis]
    assert edge == pytest.approx(side, abs=1e-9 if abs(height) < 0.99 else spacing)
    # inside of what is closed is what was inside on the grid
    margin = np.abs(grid.points[:, axis] - side)
    phi = grid.values.ravel()
    clear = (margin > 1e-6) & (np.abs(phi) > spacing**2 / RADIUS)
    assert np.array_equal(signed_distance(grid.points[clear], zero) < 0, phi[clear] < 0)
    # re-initialised, the organ still goes on beyond the border
    again = reinitialize(grid)
    assert np.array_equal(again.values < 0, grid.values < 0)
    if height in (0.0, 0.5):
        closed = signed_volume(zero) / true - 1
        figure(f"volume {grid.volume / true - 1:+.2%}, isosurface {closed:+.2%}")


@pytest.mark.parametrize("spacing", [2e-3, 4e-3, 5e-3])
def test_a_cube_that_fills_the_grid(figure, spacing):
    """Its sides lie in the border's planes, where the distance is exactly zero."""
    n = round(0.08 / spacing) + 1
    corners = np.stack(np.meshgrid(*3 * [[0.0, 0.08]], indexing="ij"), -1).reshape(-1, 3)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    cube = SurfaceMesh(corners, [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    grid = distance_in_box(cube, GridBox((0.0, 0.0, 0.0), spacing, (n, n, n)))
    # edges count a half where they have a quarter of a cell: 12 edges
    assert grid.volume == pytest.approx(0.08**3, abs=12 * 0.08 * spacing**2 / 4 + spacing**3)
    inner = GridBox(3 * (spacing,), spacing, 3 * (n - 2,))  # all of it inside
    zero = isosurface(distance_in_box(cube, inner))
    assert zero.is_watertight
    side = 0.08 - 2 * spacing
    assert signed_volume(zero) == pytest.approx(side**3, rel=1e-9)
    figure(f"{grid.volume / 0.08**3 - 1:+.2%}, cut off {signed_volume(zero) / side**3 - 1:+.0e}")


def test_random_fields_have_closed_isosurfaces():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        values = rng.standard_normal((7, 8, 9)) if seed % 2 else rng.integers(-1, 2, (7, 8, 9))
        surface = isosurface(DistanceGrid(np.zeros(3), 1.0, values.astype(float)))
        assert surface.is_watertight
        low, high = surface.bounding_box
        assert low.min() >= 0 and np.all(high <= [6, 7, 8])


def test_a_grid_beside_the_organ_is_refused():
    grid = distance_in_box(ball(level=2), GridBox((0.2, 0.2, 0.2), 5e-3, (5, 5, 5)))
    for ask in (isosurface, reinitialize):
        with pytest.raises(SurfaceError, match="move the box onto it"):
            ask(grid)


# --- 9. real livers ---------------------------------------------------------------------------


def liver_level_set(path: Path) -> tuple[float, float, float]:
    """Volume error, share of nodes near the surface where |grad phi| = 1, steepest change."""
    spacing = 2.5e-3
    surface = read_surface(path)
    grid = distance_grid(surface, spacing, 4 * spacing, band=4 * spacing)
    # the integral of the winding number: exact where closed, else but for hairline cracks
    error = grid.volume / signed_volume(surface) - 1
    band = grid.points[np.abs(grid.values.ravel()) < 3 * spacing]
    nodes = band[np.random.default_rng(1).permutation(len(band))[:3000]]
    share = float(np.mean(np.abs(gradient_length(nodes, surface) - 1) < 1e-3))
    return error, share, steepest(grid)


FOUR = ("Amos-007", "LiTS-27", "LiTS-52", "LiTS-74")  # two closed, two with slits between edges


@pytest.mark.long
def test_level_sets_of_real_livers(figure, livers_dir):
    """Of every fourth, and of the four."""
    paths = sorted(livers_dir.glob("*.obj"))
    paths = [path for i, path in enumerate(paths) if i % 4 == 0 or path.stem in FOUR]
    assert len(paths) >= 16 and {path.stem for path in paths} >= {*FOUR}
    found = {path.stem: liver_level_set(path) for path in paths}
    for name, (error, share, slope) in found.items():
        assert abs(error) < 2.5e-3, name
        assert share >= 0.99, name  # the rest straddles the skeleton or an edge
        assert slope < 1 + 1e-9, name
    errors, shares, _ = np.array(list(found.values())).T
    figure(
        f"{len(paths)}: volume within {np.abs(errors).max():.2%}, |grad| = 1 at {shares.min():.2%}"
    )
