"""Signed distance, isosurface, volume and overlap against exact shapes; orientation and
alignment against known motions.
"""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatar_core.errors import SurfaceError
from avatar_core.geometry.level_set import (
    DistanceGrid,
    GridBox,
    candidate_rotations,
    dice,
    distance_grid,
    distance_in_box,
    isosurface,
    orientation_offset,
    padded_box,
    reinitialize,
    signed_distance,
)
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.studies.alignment import align, surface_points

RADIUS = 0.06


@pytest.fixture(scope="module")
def sphere() -> SurfaceMesh:
    """Radius 60 mm, 20,480 faces: the facets lie at most 0.03 mm inside the sphere."""
    return ball(5)


def ball(n_halvings: int) -> SurfaceMesh:
    """Radius 60 mm, 20 x 4^n faces."""
    vertices, faces = igl.icosahedron()
    for _ in range(n_halvings):
        vertices, faces = igl.upsample(vertices, faces)
    vertices *= RADIUS / np.linalg.norm(vertices, axis=1, keepdims=True)
    return SurfaceMesh(vertices, faces)


def sphere_grid(spacing: float) -> DistanceGrid:
    n = 2 * round(0.09 / spacing) + 1
    axis = np.linspace(-0.09, 0.09, n)
    radius = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1), axis=-1)
    return DistanceGrid(np.full(3, -0.09), spacing, radius - RADIUS)


def gradient_length(grid: DistanceGrid) -> np.ndarray:
    """|grad phi| by central differences at the points within 1.5 spacings of the surface."""
    slopes = np.stack(np.gradient(grid.values, grid.spacing), axis=-1)
    near = np.abs(grid.values) < 1.5 * grid.spacing
    near[[0, -1]] = near[:, [0, -1]] = near[:, :, [0, -1]] = False
    return np.linalg.norm(slopes, axis=-1)[near]


def turned(surface: SurfaceMesh, rotation: np.ndarray) -> SurfaceMesh:
    return replace(surface, vertices=surface.vertices @ rotation.T)


def test_distance_to_a_sphere_is_exact_up_to_its_facets(sphere):
    points = np.random.default_rng(3).uniform(-0.1, 0.1, (2000, 3))
    exact = np.linalg.norm(points, axis=1) - RADIUS
    distance = signed_distance(points, sphere)
    assert np.max(np.abs(distance - exact)) < 3e-5
    assert distance.min() < -0.04  # negative inside


def test_sign_survives_cracks_and_flipped_faces(phantom):
    rng = np.random.default_rng(5)
    corners = np.array(phantom.vertices[phantom.faces]).reshape(-1, 3)
    corners += 2e-5 * rng.standard_normal(corners.shape)
    faces = np.arange(len(corners)).reshape(-1, 3)
    faces[::200] = faces[::200, ::-1]
    cracked = SurfaceMesh(corners, faces)
    points = rng.uniform(*phantom.bounding_box, (5000, 3))
    expected = signed_distance(points, phantom)
    clear = np.abs(expected) > 3e-3  # half an edge: a flipped face disturbs w next to itself
    assert np.array_equal(signed_distance(points[clear], cracked) < 0, expected[clear] < 0)


def test_gradient_of_a_distance_has_length_one(phantom):
    grid = distance_grid(phantom, 5e-3, 20e-3)
    slopes = np.stack(np.gradient(grid.values, grid.spacing), axis=-1)
    length = np.linalg.norm(slopes, axis=-1)[1:-1, 1:-1, 1:-1]
    assert np.abs(slopes).max() <= 1.0 + 1e-9  # a distance never changes faster than its argument
    # central differences straddle the medial axis at one point in ten
    assert np.median(np.abs(length - 1)) < 0.005
    assert np.mean(length > 0.95) > 0.85


def test_grid_reaches_the_padding_on_every_side(phantom):
    grid = distance_grid(phantom, 7e-3, 15e-3)
    low, high = phantom.bounding_box
    corner = grid.origin + grid.spacing * (np.array(grid.values.shape) - 1)
    assert np.all(low - grid.origin >= 0.015 - 1e-12)
    assert np.all(corner - high >= 0.015 - 1e-12)
    assert grid.points[-1] == pytest.approx(corner)
    assert grid.values.ravel()[-1] == pytest.approx(signed_distance(grid.points[-1:], phantom)[0])


@pytest.mark.parametrize("spacing", [10e-3, 5e-3, 2.5e-3])
def test_volume_of_the_level_set_converges(phantom, spacing):
    # the volume is that of the full grid, to the bit: the narrow band's test below
    grid = distance_grid(phantom, spacing, 2 * spacing, band=2 * spacing)
    # findings.md: 1.8 / 0.4 / 0.1 % at 10 / 5 / 2.5 mm, second order
    tolerance = 0.018 * (spacing / 10e-3) ** 2
    assert grid.volume == pytest.approx(phantom.volume, rel=tolerance)
    assert isosurface(grid).volume == pytest.approx(phantom.volume, rel=tolerance)


def test_isosurface_is_closed_outward_and_where_the_distance_is_zero():
    spacing = 5e-3
    surface = isosurface(sphere_grid(spacing), name="sphere")
    assert surface.name == "sphere"
    assert surface.is_watertight
    # linear interpolation between grid points: error h^2 / (8 R) at the most
    radius = np.linalg.norm(surface.vertices, axis=1)
    assert np.max(np.abs(radius - RADIUS)) < spacing**2 / (8 * RADIUS) * 1.01
    assert signed_distance(np.zeros((1, 3)), surface)[0] < 0


def test_isosurface_without_a_zero_raises():
    with pytest.raises(SurfaceError):
        isosurface(DistanceGrid(np.zeros(3), 1.0, np.ones((4, 4, 4))))


def test_trilinear_sampling_reproduces_affine_fields_and_stops_at_the_edge():
    grid = DistanceGrid(np.array([1.0, 2.0, 3.0]), 0.5, np.zeros((5, 6, 7)))
    slope = np.array([0.3, -2.0, 1.1])
    grid = replace(grid, values=(grid.points @ slope + 4.0).reshape(5, 6, 7))
    points = np.random.default_rng(2).uniform([1, 2, 3], [3, 4.5, 6], (100, 3))
    assert np.allclose(grid.sample(points), points @ slope + 4.0, atol=1e-13)
    assert grid.sample(np.array([[-9.0, 2.0, 3.0]]))[0] == pytest.approx(grid.values[0, 0, 0])


# --- boxes and narrow bands -------------------------------------------------------------------


def test_grid_in_a_fixed_box_has_the_shape_asked_for(phantom):
    box = GridBox((-0.18, -0.13, -0.15), 8e-3, (43, 31, 37))
    grid = distance_in_box(phantom, box)
    assert grid.values.shape == (43, 31, 37)
    assert grid.box == box
    assert np.allclose(box.upper, [0.156, 0.11, 0.138])
    assert np.array_equal(box.points, grid.points)
    n = 31 * 37 * 5 + 37 * 7 + 11
    assert np.allclose(box.points[n], np.array(box.origin) + 8e-3 * np.array([5, 7, 11]))
    assert grid.values[5, 7, 11] == signed_distance(box.points[n : n + 1], phantom)[0]


def test_margin_says_how_far_a_surface_is_from_the_sides(phantom):
    box = padded_box([phantom], 5e-3, 12e-3)
    # up to half a cell is added to a whole number of them
    assert 0.012 <= box.margin(phantom) + 1e-12 <= 0.0146
    shifted = replace(phantom, vertices=phantom.vertices + np.array([0, 0.03, 0]))
    assert box.margin(shifted) == pytest.approx(
        box.upper[1] - shifted.bounding_box[1][1], abs=1e-12
    )
    assert box.margin(shifted) < 0
    both = padded_box([phantom, shifted], 5e-3, 12e-3)
    assert min(both.margin(phantom), both.margin(shifted)) >= 0.012 - 1e-12


@pytest.mark.parametrize(
    "name", ["phantom", "LiTS-23", pytest.param("Amos-007", marks=pytest.mark.long)]
)
def test_narrow_band_equals_the_full_grid_near_the_surface(request, phantom, name):
    surface = phantom
    if name != "phantom":
        surface = read_surface(request.getfixturevalue("livers_dir") / f"{name}.obj")
    spacing, band = 6e-3, 12e-3
    full = distance_grid(surface, spacing, 3 * spacing)
    narrow = distance_grid(surface, spacing, 3 * spacing, band=band)
    assert narrow.box == full.box
    # bit for bit: the same distances are computed, or none
    assert np.array_equal(narrow.values, np.clip(full.values, -band, band))
    assert narrow.volume == full.volume
    assert isosurface(narrow).volume == isosurface(full).volume


def test_narrow_band_computes_few_of_many_points(phantom, monkeypatch):
    asked: list[int] = []

    def counted(points: np.ndarray, surface: SurfaceMesh) -> np.ndarray:
        asked.append(len(points))
        return signed_distance(points, surface)

    monkeypatch.setattr("avatar_core.geometry.level_set.signed_distance", counted)
    grid = distance_grid(phantom, 2e-3, 6e-3, band=4e-3)
    # the shell of 4 mm + 3.5 mm on both sides of 0.09 m2 is 0.17 M points of 0.9 M
    assert sum(asked) < 0.25 * grid.values.size


def test_too_narrow_a_band_raises(phantom):
    with pytest.raises(SurfaceError, match=r"choose at least 0\.01 m"):
        distance_grid(phantom, 5e-3, 10e-3, band=9e-3)


# --- real livers ------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [20, pytest.param(3, marks=pytest.mark.long)])
def test_no_wrong_sign_on_real_livers(livers_dir, step):
    rng = np.random.default_rng(7)
    for path in sorted(livers_dir.glob("*.obj"))[::step]:
        surface = read_surface(path)
        low, high = surface.bounding_box
        points = rng.uniform(low - 0.01, high + 0.01, (1000, 3))
        # the sum of solid angles over all triangles, without the tree and its expansions
        winding = igl.winding_number(surface.vertices, surface.faces.astype(np.int64), points)
        assert np.array_equal(signed_distance(points, surface) < 0, winding > 0.5), path.stem


@pytest.mark.parametrize(
    "name",
    [
        "LiTS-16",
        "LiTS-23",
        *(pytest.param(n, marks=pytest.mark.long) for n in ("LiTS-4", "LiTS-60")),
    ],
)
def test_volume_of_a_real_liver(livers_dir, name):
    surface = read_surface(livers_dir / f"{name}.obj")
    assert surface.is_watertight  # otherwise its own volume is a quadrature
    for spacing, tolerance in ((5e-3, 5e-3), (2.5e-3, 1.5e-3)):  # asked for
        grid = distance_grid(surface, spacing, 2 * spacing, band=2 * spacing)
        assert grid.volume == pytest.approx(surface.volume, rel=tolerance)


# --- blended fields, overlap and distance -----------------------------------------------------


@pytest.mark.parametrize("spacing", [9e-3, 4.5e-3])
def test_reinitialised_field_is_the_distance_to_the_same_zero_surface(spacing):
    exact = sphere_grid(spacing)
    x = exact.points[:, 0].reshape(exact.values.shape)
    factor = 1.1 + 0.25 * np.tanh(exact.values / 0.03) + 1.5 * x  # |grad| 0.8 to 1.4
    bent = replace(exact, values=exact.values * factor)
    assert np.abs(gradient_length(bent) - 1).mean() > 0.05
    grid = reinitialize(bent)
    # chords lie inside the sphere by h^2 / (8 R) for each of two or three directions, and the
    # given field is bent between grid points: measured 0.51 and 0.13 mm, second order
    assert np.abs(grid.values - exact.values).max() < 4 * spacing**2 / (8 * RADIUS)
    # measured 0.010 at 8 mm and 0.004 at 4 mm
    assert np.abs(gradient_length(grid) - 1).mean() < 0.015 * spacing / 9e-3
    assert np.array_equal(grid.values < 0, bent.values < 0)


def test_blend_of_organs_becomes_a_distance_again(phantom):
    others = [
        replace(phantom, vertices=phantom.vertices * s) for s in ([1.15, 0.9, 1], [0.9, 1, 1.1])
    ]
    box = padded_box([phantom, *others], 5e-3, 15e-3)
    fields = [distance_in_box(organ, box).values for organ in (phantom, *others)]
    blend = DistanceGrid(
        np.array(box.origin), 5e-3, 1.2 * fields[0] + 0.9 * fields[1] - 1.1 * fields[2]
    )
    grid = reinitialize(blend)
    assert np.median(np.abs(gradient_length(blend) - 1)) > 0.015
    assert np.abs(gradient_length(blend) - 1).mean() > 0.05
    assert np.median(np.abs(gradient_length(grid) - 1)) < 0.01
    # where two sides of an edge or of the notch are close, central differences see less than one
    assert np.abs(gradient_length(grid) - 1).mean() < 0.02
    # second order, like the volume of the level set: 0.4 % at 5 mm
    assert isosurface(grid).volume == pytest.approx(isosurface(blend).volume, rel=4e-3)


def test_reinitialising_nothing_raises():
    with pytest.raises(SurfaceError):
        reinitialize(DistanceGrid(np.zeros(3), 1.0, np.ones((4, 4, 4))))


def test_dice_of_spheres():
    big = sphere_grid(3e-3)
    small = replace(big, values=big.values + 0.010)  # radius 50 mm inside 60 mm
    ratio = (50 / 60) ** 3
    # second-order quadrature: (h / R)^2 = 0.25 %
    assert dice(big, small) == pytest.approx(2 * ratio / (1 + ratio), abs=2e-3)
    assert dice(big, big) == pytest.approx(1.0, abs=1e-12)
    assert dice(small, big) == dice(big, small)
    centre = np.array([0.024, 0, 0])  # a whole number of cells to the side
    beside = np.linalg.norm(big.points - centre, axis=1).reshape(big.values.shape) - RADIUS
    # lens of two equal spheres at distance d: (1 - 3/4 d/R + (d/R)^3 / 16) of each
    d = 0.024 / RADIUS
    assert dice(big, replace(big, values=beside)) == pytest.approx(
        1 - 0.75 * d + d**3 / 16, abs=2e-3
    )
    far = replace(big, values=np.abs(big.values) + 0.01)
    assert dice(big, far) == 0.0


def test_dice_of_what_cannot_be_compared_raises():
    big = sphere_grid(6e-3)
    with pytest.raises(SurfaceError, match="one GridBox"):
        dice(big, replace(big, origin=big.origin + 1e-3))
    empty = replace(big, values=np.abs(big.values) + 0.1)
    with pytest.raises(SurfaceError, match="empty"):
        dice(empty, empty)


# --- alignment --------------------------------------------------------------------------------


def test_points_on_a_surface_are_spread_by_area(sphere):
    half = sphere.vertices[sphere.faces].mean(axis=1)[:, 0] > 0
    corners = np.vstack([sphere.faces[half], sphere.faces[~half]])
    points = surface_points(replace(sphere, faces=corners), 1000)
    assert np.abs(points.mean(axis=0)).max() < 0.02 * RADIUS
    assert np.abs(np.mean(points[:, 0] > 0) - 0.5) < 2e-3


MOTIONS = [  # rotation vector [degrees], scale, translation [m]
    ((0, 0, 0), 1.0, (0.0, 0.0, 0.0)),
    ((20, -10, 5), 1.2, (0.05, -0.03, 0.08)),
    ((0, 180, 0), 0.8, (0.0, 0.1, 0.0)),
    ((-110, 40, 75), 1.1, (-0.2, 0.0, 0.1)),
    ((45, 45, 100), 0.9, (0.0, 0.0, 0.3)),
]


@pytest.mark.parametrize(
    ("name", "motion"),
    [
        *(("phantom", i) for i in (0, 1, 4)),
        ("LiTS-4", 3),
        *(
            pytest.param(name, i, marks=pytest.mark.long)
            for name, i in (("phantom", 2), ("phantom", 3), ("LiTS-4", 1), ("LiTS-60", 2))
        ),
    ],
)
def test_alignment_recovers_a_known_motion(request, phantom, name, motion):
    turn, scale, shift = MOTIONS[motion]
    surface = phantom
    if name != "phantom":
        surface = read_surface(request.getfixturevalue("livers_dir") / f"{name}.obj")
    rotation = Rotation.from_rotvec(turn, degrees=True).as_matrix()
    moved = scale * surface.vertices @ rotation.T + shift
    found = align(surface, replace(surface, vertices=moved))
    between = Rotation.from_matrix(found.rotation @ rotation.T).magnitude()
    # the grids of 24 cells differ after a rotation: their interpolation error is 0.5 to 1 mm,
    # over 60 random motions of ten livers at most 0.06 degrees, 7e-4 and 0.26 mm
    assert np.degrees(between) < 0.15
    assert found.scale == pytest.approx(scale, rel=2e-3)
    assert np.abs(found.apply(surface.vertices) - moved).max() < 6e-4
    assert np.allclose(found.invert(found.apply(surface.vertices)), surface.vertices, atol=1e-12)
    assert found.residual < 1.5e-3


def test_rigid_alignment_leaves_the_size(phantom):
    rotation = Rotation.from_rotvec([0.3, 0.1, -0.2]).as_matrix()
    reference = replace(phantom, vertices=1.1 * phantom.vertices @ rotation.T)
    found = align(phantom, reference, scale=False)
    assert found.scale == 1.0
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert found.angle == pytest.approx(np.degrees(np.linalg.norm([0.3, 0.1, -0.2])), abs=1.0)
    assert found.residual > 2e-3  # a tenth of the size is left between them


@pytest.mark.long
def test_similarity_fits_better_than_equal_volumes(livers_dir):
    one, other = (read_surface(livers_dir / f"LiTS-{n}.obj") for n in (65, 16))
    ratio = (other.volume / one.volume) ** (1 / 3)
    same_volume = replace(one, vertices=ratio * one.vertices)
    rigid = align(same_volume, other, scale=False)
    # a long thin lobe: measured 9.3 against 9.9 mm
    assert align(one, other).residual < 0.97 * rigid.residual


def mean_distance(one: SurfaceMesh, other: SurfaceMesh) -> float:
    """Of points of either surface, even by area, to the other [m]."""
    pairs = ((one, other), (other, one))
    return float(
        np.mean([np.abs(signed_distance(surface_points(a, 3000), b)).mean() for a, b in pairs])
    )


@pytest.mark.long
def test_alignment_of_two_patients_does_not_depend_on_where_they_lie(livers_dir):
    one, other = (read_surface(livers_dir / f"LiTS-{n}.obj") for n in (4, 16))
    before = mean_distance(one, other)
    found = align(one, other)
    after = mean_distance(found.moved(one), other)
    assert after < 0.5 * before
    # the residual is in lengths of the reference, whatever the size of what is laid on it
    small = replace(one, vertices=0.5 * one.vertices)
    assert align(small, other).residual == pytest.approx(found.residual, rel=0.02)
    rotation = Rotation.from_rotvec([0, 95, 40], degrees=True).as_matrix()
    again = align(turned(one, rotation), other).moved(turned(one, rotation))
    # the interpolation error of the grids, 0.5 to 1 mm, is averaged over 3000 points
    assert mean_distance(again, other) == pytest.approx(after, abs=2e-4)


# --- orientation ------------------------------------------------------------------------------


def test_candidate_rotations_are_168_different_rotations():
    rotations = candidate_rotations()
    assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(rotations), 1.0)
    assert len(np.unique(rotations.round(6), axis=0)) == 168


@pytest.mark.parametrize(
    ("angle", "axis"),
    [
        pytest.param(angle, axis, marks=[pytest.mark.long] * (axis != k % 3))
        for k, angle in enumerate([0, 20, 70, 90, 180, 270])
        for axis in range(3)
    ],
)
def test_a_turned_phantom_warns_and_a_tilted_one_does_not(phantom, axis, angle):
    rotation = Rotation.from_rotvec(np.radians(angle) * np.eye(3)[axis]).as_matrix()
    offset = orientation_offset(turned(phantom, rotation), phantom)
    assert offset.is_turned == (angle >= 70)
    assert (offset.warning is not None) == offset.is_turned
    if angle % 90 == 0:  # one of the candidates: found exactly
        assert np.allclose(offset.rotation @ rotation, np.eye(3), atol=1e-6)
    if offset.is_turned:
        assert "--axes" in offset.warning
        assert "\n" not in offset.warning


def test_orientation_ignores_place_and_size(phantom):
    moved = replace(phantom, vertices=1.3 * phantom.vertices + np.array([0.2, -0.1, 0.4]))
    offset = orientation_offset(moved, phantom)
    assert (offset.angle, offset.gain, offset.is_turned) == (pytest.approx(0.0), 1.0, False)


TURNED = {f"LiTS-{n}" for n in (6, 7, 8, 9, 10)}
UPRIGHT = "Amos-007"  # of another source


def turns(files, phantom):
    """Gain of every file, and the names of those that count as turned."""
    offsets = {path.stem: orientation_offset(read_surface(path), phantom) for path in files}
    gains = {name: offset.gain for name, offset in offsets.items()}
    return gains, {name for name, offset in offsets.items() if offset.is_turned}


def test_turned_livers_warn_and_upright_ones_do_not(livers_dir, phantom):
    """One of each kind; the long test below asks more."""
    some = sorted(TURNED)[0]
    files = [livers_dir / f"{name}.obj" for name in (some, UPRIGHT)]
    assert turns(files, phantom)[1] == {some}


@pytest.mark.long
def test_only_the_turned_livers_warn(livers_dir, phantom):
    """All that are turned, and every third of the others."""
    others = [path for path in sorted(livers_dir.glob("*.obj")) if path.stem not in TURNED]
    files = [*(livers_dir / f"{name}.obj" for name in sorted(TURNED)), *others[::3]]
    gains, turned = turns(files, phantom)
    assert turned == TURNED
    # room on both sides of the threshold 1.15, so that the next liver is judged the same
    assert max(gain for name, gain in gains.items() if name not in turned) < 1.10
    assert min(gains[name] for name in turned) > 1.25


WRONG = ("LPS", "RIA", "RSP", "SRA", "LIP")


@pytest.mark.parametrize(
    ("name", "wrong"),
    [
        ("LiTS-16", WRONG[:2]),
        pytest.param("LiTS-16", WRONG[2:], marks=pytest.mark.long),
        *(pytest.param(n, WRONG, marks=pytest.mark.long) for n in ("LiTS-50", "Amos-007")),
    ],
)
def test_a_real_liver_with_wrong_axes_warns(livers_dir, phantom, name, wrong):
    path = livers_dir / f"{name}.obj"
    for axes in wrong:
        offset = orientation_offset(read_surface(path, axes=axes), phantom)
        assert offset.is_turned, axes
