"""Position of supports: by rule on a liver, by groups of points, and the rest for tools."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from avatar_core.common.supports import ATTACHMENTS
from avatar_core.errors import AvatarError, CoordinateError, MaterialError, MeshError
from avatar_core.geometry.attachments import attachments_by_rule
from avatar_core.geometry.groups import faces_of_groups, read_groups, regions_from_groups
from avatar_core.geometry.mesh import TetMesh, regions_by_rule, touching
from avatar_core.offline.supports import TYPICAL, SupportOption, held_by
from avatar_core.pipeline import OrganOptions
from avatar_core.reduction.coordinates import Coordinate


@pytest.fixture(scope="module")
def places(phantom_mesh: TetMesh) -> dict[str, np.ndarray]:
    return attachments_by_rule(phantom_mesh)


def centre(mesh: TetMesh, faces: np.ndarray) -> np.ndarray:
    """Return the centroid of some faces [m]."""
    middle = mesh.vertices[mesh.boundary_faces[faces]].mean(axis=1)
    return np.asarray(np.average(middle, axis=0, weights=mesh.face_areas[faces]))


def test_attachments_lie_where_anatomy_has_them(
    phantom_mesh: TetMesh, places: dict[str, np.ndarray]
) -> None:
    assert tuple(places) == ATTACHMENTS
    at = {name: centre(phantom_mesh, faces) for name, faces in places.items()}
    organ = centre(phantom_mesh, np.ones(len(phantom_mesh.boundary_faces), bool))
    # RAS: x to the patient's right side in this project's livers, y forward, z up
    along_x = ["left_triangular", "falciform", "cava_groove", "bare_area", "right_triangular"]
    assert [at[name][0] for name in along_x] == sorted(at[name][0] for name in along_x)
    for name in ("bare_area", "cava_groove"):
        assert at[name][1] < organ[1]
    assert at["bare_area"][2] > organ[2]
    assert at["falciform"][1] > organ[1]
    area, whole = phantom_mesh.face_areas, phantom_mesh.face_areas.sum()
    assert 0.06 * whole < area[places["bare_area"]].sum() <= 0.10 * whole
    for faces in places.values():
        assert 0.002 * whole < area[faces].sum() < 0.11 * whole


def test_no_face_belongs_to_two_attachments(places: dict[str, np.ndarray]) -> None:
    assert np.stack(list(places.values())).sum(axis=0).max() == 1


def test_attachments_move_with_the_organ(
    phantom_mesh: TetMesh, places: dict[str, np.ndarray]
) -> None:
    moved = TetMesh(phantom_mesh.vertices + np.array([0.3, -0.1, 0.05]), phantom_mesh.tets)
    for name, faces in attachments_by_rule(moved).items():
        assert (faces != places[name]).mean() < 0.005  # rounding at borders of the rule


def test_a_tool_reaches_what_looks_forward_and_is_not_held(
    phantom_mesh: TetMesh, places: dict[str, np.ndarray]
) -> None:
    options = [SupportOption.parse("bare_area=clamped"), SupportOption.parse("falciform=1e5")]
    regions, supports = held_by(phantom_mesh, options)
    np.testing.assert_array_equal(regions.clamped, places["bare_area"])
    assert [support.name for support in supports] == ["falciform"]
    assert not (regions.accessible & places["falciform"]).any()
    assert not (regions.accessible & touching(phantom_mesh, regions.clamped)).any()
    usual = regions_by_rule(phantom_mesh)
    rest = usual.accessible & ~places["falciform"] & ~touching(phantom_mesh, regions.clamped)
    assert (regions.accessible[rest]).mean() > 0.95


def test_on_springs_alone_nothing_is_clamped(phantom_mesh: TetMesh) -> None:
    regions, (support,) = held_by(phantom_mesh, [SupportOption.parse("bare_area")])
    assert not regions.clamped.any()
    assert support.stiffness == TYPICAL["bare_area"]


def groups_file(path: Path, mesh: TetMesh, **regions: np.ndarray) -> Path:
    points = {
        name: mesh.vertices[np.unique(mesh.boundary_faces[faces])]
        for name, faces in regions.items()
    }
    np.savez(path, **points)
    return path


def test_groups_of_points_override_rules_and_add_places(
    phantom_mesh: TetMesh, places: dict[str, np.ndarray], tmp_path: Path
) -> None:
    cap = regions_by_rule(phantom_mesh).clamped
    left = places["left_triangular"]
    file = groups_file(tmp_path / "groups.npz", phantom_mesh, bare_area=left, dome=cap)
    options = [SupportOption.parse(text) for text in ("bare_area=1e6", "dome=1e4", "falciform")]
    regions, supports = held_by(phantom_mesh, options, file)
    bare, dome, falciform = (support.faces for support in supports)
    assert bare[left].all()
    assert not bare[places["bare_area"] & ~touching(phantom_mesh, left)].any()
    assert dome[cap].all()
    np.testing.assert_array_equal(falciform, places["falciform"])
    assert not regions.clamped.any()


def test_a_file_of_groups_may_clamp_beside_the_supports(
    phantom_mesh: TetMesh, places: dict[str, np.ndarray], tmp_path: Path
) -> None:
    usual = regions_by_rule(phantom_mesh)
    file = groups_file(
        tmp_path / "g.npz", phantom_mesh, clamped=places["cava_groove"], accessible=usual.accessible
    )
    regions, _ = held_by(phantom_mesh, [SupportOption.parse("bare_area=1e6")], file)
    assert regions.clamped[places["cava_groove"]].all()
    # with the same file and no supports, the organ is clamped there alone
    alone = regions_from_groups(phantom_mesh, file)
    np.testing.assert_array_equal(alone.clamped, regions.clamped)
    assert not (
        regions.accessible & ~faces_of_groups(phantom_mesh, read_groups(file))["accessible"]
    ).any()


def test_a_tool_does_not_reach_what_touches_the_clamp_of_a_file(
    phantom_mesh: TetMesh, places: dict[str, np.ndarray], tmp_path: Path
) -> None:
    everywhere = np.ones(len(phantom_mesh.boundary_faces), bool)
    clamped = places["bare_area"]
    file = groups_file(tmp_path / "g.npz", phantom_mesh, clamped=clamped, accessible=everywhere)
    regions = regions_from_groups(phantom_mesh, file)
    np.testing.assert_array_equal(regions.accessible, ~touching(phantom_mesh, regions.clamped))


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"no zip", "cannot read node groups"),
        ({"clamped": np.zeros((4, 2))}, "points are rows of three finite numbers"),
        ({"dome": np.zeros((4, 3))}, "'clamped' is not in it"),
    ],
)
def test_a_file_that_holds_no_groups_is_refused(
    phantom_mesh: TetMesh, tmp_path: Path, content: bytes | dict[str, np.ndarray], reason: str
) -> None:
    path = tmp_path / "g.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.savez(path, **content)
    with pytest.raises(MeshError, match=reason):
        regions_from_groups(phantom_mesh, path)


def test_a_support_that_is_nowhere_is_refused(phantom_mesh: TetMesh) -> None:
    with pytest.raises(MeshError, match=r"no support 'dome'; choose one of cava_groove, bare_area"):
        held_by(phantom_mesh, [SupportOption.parse("dome=1e5")])


# --- options of the command line ------------------------------------------------------------------


def test_a_support_is_fixed_free_to_choose_or_clamped() -> None:
    assert SupportOption.parse("bare_area=2e5").stiffness == 2e5
    assert SupportOption.parse("falciform").stiffness == TYPICAL["falciform"]
    assert SupportOption.parse("bare_area=clamped").stiffness == np.inf
    free = SupportOption.parse("bare_area=1e5:1e9")
    assert free.coordinate == Coordinate("support.bare_area", 1e5, 1e9)
    assert free.stiffness == TYPICAL["bare_area"]
    assert SupportOption.parse("dome=1e5:1e7:2").stiffness == pytest.approx(1e6)
    for text in ("bare_area=200000", "bare_area=clamped", "dome=100000:1e+07:2"):
        assert str(SupportOption.parse(text)) == text


@pytest.mark.parametrize(
    ("text", "kind", "reason"),
    [
        ("bare_area=soft", CoordinateError, "write NAME=STIFFNESS"),
        ("dome", CoordinateError, "NAME alone for one of cava_groove"),
        ("bare_area=0", MaterialError, "leave it out for a free surface"),
        ("bare_area=1e9:1e5", CoordinateError, "LOW < HIGH"),
        ("bare_area=0:1e5", CoordinateError, "1 <= LOW"),
        ("clamped=1e5", MaterialError, "letters, digits and _"),
        ("bare area=1e5", MaterialError, "letters, digits and _"),
        ("=1e5", MaterialError, "letters, digits and _"),
    ],
)
def test_a_bad_support_option_is_refused(text: str, kind: type[AvatarError], reason: str) -> None:
    with pytest.raises(kind, match=reason):
        SupportOption.parse(text)


def test_options_that_exclude_supports_are_refused_before_any_work() -> None:
    supports = (SupportOption.parse("bare_area=1e5"),)
    for options, reason in (
        ({"large": "neo-hookean"}, "supports"),
        ({"n_contact_sites": 3}, "supports"),
        ({"supports": supports * 2}, "given twice: bare_area, bare_area"),
        ({"coordinates": (Coordinate("support.bare_area", 1e5, 1e9),)}, "--support"),
    ):
        with pytest.raises(CoordinateError, match=reason):
            OrganOptions(**{"supports": supports, **options})  # type: ignore[arg-type]
