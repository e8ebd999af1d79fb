"""A planner's session on the page, from a patient's images to files for other programs.

One session for all tests: a patient is built from a label map with a tumour, pressed beside it,
measured, kept, recorded, replayed, reported and exported. Each test looks at one thing of it. It
takes ten minutes where no graphics card draws, and is held only if it is asked for:
``AVATAR_SESSION_MINUTES=1 pytest -m long tests/ros/ui/test_session.py -s``.
"""

from __future__ import annotations

import re
import zlib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import igl
import meshio
import nibabel
import numpy as np
import pytest
from avatar_ros.bench.cell import Module

from avatar_core.geometry.tip import Tip
from tests.helpers.slowness import slowness
from tests.ros.helpers.planner import (
    ASKED,
    CENTRE,
    NOTE,
    TUMOUR,
    VOXEL,
    Session,
    hold,
    labels,
    recorded,
)

pytestmark = [
    pytest.mark.long,
    pytest.mark.timing,  # a browser that draws without a graphics card takes both cores
    pytest.mark.skipif(not ASKED, reason="takes ten minutes: set AVATAR_SESSION_MINUTES"),
]

AGREE = 0.1  # numbers of the page and of files [mm]
FIRST_PICTURE = 3.0  # after the address was asked for, on a machine with nothing else to do [s]
GROWN = 10.0  # memory that a node may take from the first round to the last [MB]
GROWN_PAGE = 5.0  # the same of the browser's page [MB]


@pytest.fixture(scope="module")
def folder(folder: Path) -> Path:
    nibabel.save(labels(), folder / "case.nii.gz")
    return folder


@pytest.fixture(scope="module")
def session(page: Any, nodes: dict[str, Module], folder: Path, shots: Path) -> Session:
    made = Session(folder)
    hold(page, made, {name: node.pid for name, node in nodes.items()}, shots)
    return made


# --- What it shows ----------------------------------------------------------------------------


def opened_vtp(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points and triangles, as any reader of XML finds them."""
    piece = ElementTree.parse(path).getroot().find("PolyData/Piece")
    assert piece is not None
    (points,) = piece.iterfind("Points/DataArray")
    faces = piece.find("Polys/DataArray[@Name='connectivity']")
    assert faces is not None
    return (
        np.fromstring(str(points.text), sep=" ").reshape(-1, 3),
        np.fromstring(str(faces.text), int, sep=" ").reshape(-1, 3),
    )


def opened_stl(path: Path) -> tuple[np.ndarray, np.ndarray]:
    mesh = meshio.read(path)
    return mesh.points.astype(float), mesh.cells_dict["triangle"]


def tumour_of(organ: Path) -> Path:
    return organ.with_name(f"{organ.stem}_label_{TUMOUR}{organ.suffix}")


def lps(point: np.ndarray) -> np.ndarray:
    """A point or direction, RAS [m], as the files have it, LPS [mm]."""
    return 1e3 * point * [-1.0, -1.0, 1.0]


def distance(point: np.ndarray, body: tuple[np.ndarray, np.ndarray]) -> float:
    """From a point to a surface [mm]."""
    square, _, _ = igl.point_mesh_squared_distance(point[None], *body)
    return float(np.sqrt(square[0]))


def places(session: Session, mode: str) -> tuple[np.ndarray, np.ndarray]:
    """What was clicked on, at rest and pressed, (n, 3) [mm]."""
    (rest, faces), (moved, _) = (opened_vtp(s[".vtp"]) for s in (session.rest, session.pressed))
    found = []
    for origin, direction in session.clicks[mode]:
        hits = igl.ray_mesh_intersect(lps(origin), lps(direction), rest, faces)
        k, _, u, v = min(hits, key=lambda hit: hit[1])
        corners = faces[k]
        found.append([np.array([1.0 - u - v, u, v]) @ points[corners] for points in (rest, moved)])
    at = np.array(found)
    return at[:, 0], at[:, 1]


def test_the_patient_lies_where_its_image_does(session: Session) -> None:
    """Whichever way its voxels run."""
    print(f"\nbuilt in {session.built_in:.0f} s")
    points, _ = opened_vtp(tumour_of(session.rest[".vtp"]))
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    np.testing.assert_allclose(middle, lps(CENTRE), atol=1e3 * VOXEL)


def test_depth_and_way_to_the_tumour_are_those_of_the_files(session: Session) -> None:
    tip, radius = lps(session.tip), 1e3 * Tip().radius
    depth = radius - distance(tip, opened_vtp(session.rest[".vtp"]))
    way = distance(tip, opened_stl(tumour_of(session.pressed[".stl"]))) - radius
    said = session.said(r"Tip ([\d.]+) mm below"), session.said(r"Tool to label 2: ([\d.]+) mm")
    print(f"\ndepth {depth:.2f} mm, said {said[0]}; to the tumour {way:.2f} mm, said {said[1]}")
    assert said[0] == pytest.approx(depth, abs=AGREE)
    assert said[1] == pytest.approx(way, abs=AGREE)


def test_the_margin_is_that_of_the_files_at_rest_and_pressed(session: Session) -> None:
    for when, corners, files in zip(
        ("at rest", "now"),
        places(session, "plane (3 points)"),
        (session.rest, session.pressed),
        strict=True,
    ):
        tumour, _ = opened_vtp(tumour_of(files[".vtp"]))
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        margin = np.abs((tumour - corners[0]) @ normal / np.linalg.norm(normal)).min()
        said = session.said(rf"Margin to label 2:.* ([\d.]+) mm {when}")
        print(f"\nmargin {margin:.2f} mm {when}, said {said}")
        assert said == pytest.approx(margin, abs=AGREE)


def test_displacements_are_those_of_the_files(session: Session) -> None:
    rest, pressed = places(session, "probe")
    moved = float(np.linalg.norm(pressed - rest))
    (before, _), (after, _) = opened_vtp(session.rest[".vtp"]), opened_vtp(session.pressed[".vtp"])
    largest = np.linalg.norm(after - before, axis=1).max()
    said = (
        session.said(r"Probe: displacement ([\d.]+) mm"),
        session.said(r"displacement ([\d.]+) mm"),
    )
    print(f"\nprobe {moved:.3f} mm, said {said[0]}; largest {largest:.2f} mm, said {said[1]}")
    assert said[0] == pytest.approx(moved, abs=AGREE)


def test_both_formats_hold_the_same_surfaces(session: Session) -> None:
    for of in (lambda path: path, tumour_of):
        (a, p), (b, q) = (
            opened_stl(of(session.pressed[".stl"])),
            opened_vtp(of(session.pressed[".vtp"])),
        )
        assert len(p) == len(q)
        np.testing.assert_allclose(a[p].mean(axis=1), b[q].mean(axis=1), atol=1e-3)


def test_a_kept_state_comes_back(session: Session) -> None:
    assert session.back == session.measures


def test_a_recording_is_replayed_as_it_was(session: Session) -> None:
    part, numbers, alerts = session.played
    since, forces = recorded(session)
    at = np.abs(since - part * since[-1]) <= 0.001 * since[-1] + 1.0 / 30.0
    found = re.search(r"Force ([\d.]+) N", "".join(numbers))
    assert found
    print(f"\n{since[-1]:.1f} s, force at {part:.0%}: {forces[at]}, said {found[1]}")
    assert np.abs(forces[at] - float(found[1])).min() < 0.01
    assert float(found[1]) > 0.1
    assert session.recording.name in alerts and "not what the tool feels now" in alerts


def test_reports_hold_what_the_page_said(session: Session) -> None:
    html = session.reports["HTML"].read_text()
    pdf = text_of(session.reports["PDF"].read_bytes())
    for line in [*session.numbers, *session.measures, NOTE]:
        assert line in html
        assert re.sub(r"\W", "", line) in pdf


def text_of(pdf: bytes) -> str:
    """The letters and numbers of a PDF of matplotlib, without what is between them."""
    streams = re.findall(rb"stream\r?\n(.*?)endstream", pdf, re.DOTALL)
    found = []
    for stream in streams:
        try:
            page = zlib.decompress(stream)
        except zlib.error:  # an image
            continue
        found += re.findall(rb"\(((?:\\.|[^()\\])*)\)", page)
    return re.sub(r"\W", "", b"".join(found).decode("latin-1"))


def test_memory_of_page_and_nodes_is_flat(session: Session) -> None:
    """What no system can reclaim of each node, and what the page's scripts keep after a collection,
    from the end of the first round to that of the last."""
    (begin, heap_then), (end, heap_now) = session.memory[0], session.memory[-1]
    print(f"\n{len(session.memory)} rounds; page {heap_then:.1f} MB, {heap_now - heap_then:+.1f}")
    for name, before in begin.items():
        grown = end[name].memory_mb - before.memory_mb
        rounds = " ".join(f"{now[name].memory_mb:.0f}" for now, _ in session.memory)
        print(f"{name}: {before.memory_mb:.0f} MB, {grown:+.1f}; {rounds}")
        assert grown < GROWN, name
        assert end[name].files <= before.files + 2 and end[name].threads <= before.threads + 2
    assert heap_now - heap_then < GROWN_PAGE


def test_the_organ_is_seen_soon(session: Session) -> None:
    median = float(np.median(session.first_pictures))
    print(f"\nfirst picture after {session.first_pictures} s")
    assert median < FIRST_PICTURE * slowness()
