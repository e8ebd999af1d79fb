"""The organ for RViz and Foxglove: the right triangles, coloured, at display rate and no faster."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import yaml
from visualization_msgs.msg import Marker

from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from avatar_ros.ui.view.colours import colours, table, top_for
from tests.helpers.paths import PARAMS
from tests.helpers.slowness import within
from tests.ros.helpers.doc_pages import entry, index, topic
from tests.ros.helpers.hand import Hand, wait_for_model
from tests.ros.helpers.running import running

pytestmark = pytest.mark.long  # it builds an organ and starts nodes


@pytest.fixture(scope="module")
def probe(lasting_probe: Any) -> Any:
    return lasting_probe


@pytest.fixture(scope="module")
def markers(own_domain: dict[str, str]) -> Iterator[Module]:
    with running("organ_markers", own_domain) as process:
        yield process


def corners(marker: Marker) -> np.ndarray:
    return np.array([(p.x, p.y, p.z) for p in marker.points])


def shades(marker: Marker) -> np.ndarray:
    return np.array([(c.r, c.g, c.b, c.a) for c in marker.colors])


def test_the_rest_shape_is_latched(markers: Any, cell: Any, probe: Any, organ: Any) -> None:
    marker = probe.next(Marker, "organ_rest", qos.LATCHED)
    assert (marker.type, marker.header.frame_id) == (Marker.TRIANGLE_LIST, "organ")
    expected = organ.surface_vertices[organ.surface_faces.reshape(-1)]
    np.testing.assert_array_equal(corners(marker), expected)
    assert len(marker.colors) == len(marker.points)


def test_the_deformed_organ_is_coloured(
    markers: Any, cell: Any, probe: Any, organ: Any, touch: tuple[np.ndarray, np.ndarray]
) -> None:
    wait_for_model(cell, probe)
    faces = organ.surface_faces.reshape(-1)
    rest = organ.surface_vertices[faces]

    def deformed(marker: Marker) -> bool:
        return bool(np.abs(corners(marker) - rest).max() > 1e-3)

    marker = probe.next(
        Marker, "organ_deformed", qos.COMMAND, deformed, 30.0, Hand(probe, touch[0])
    )
    moved = corners(marker) - rest
    # float32 of 0.1 m, twice, in a scale of 10 mm: the next colour of 256 at most
    next_shade = np.abs(np.diff(table(), axis=0)).max() + 1e-6
    np.testing.assert_allclose(shades(marker)[:, :3], colours(moved, 0.01), atol=next_shade)
    assert marker.header.frame_id == "organ"


def test_it_comes_at_display_rate(
    markers: Any, cell: Any, probe: Any, touch: tuple[np.ndarray, np.ndarray]
) -> None:
    came: list[float] = []
    probe.node.create_subscription(
        Marker, "organ_deformed", lambda _: came.append(time.monotonic()), qos.COMMAND
    )
    probe.until(lambda: len(came) > 5, 30.0)
    came.clear()
    with within(3.0):  # distinguishes a working timer from a broken one
        probe.until(lambda: len(came) > 30, 10.0)
    came.clear()
    probe.spin(3.0)
    assert len(came) <= 95  # out of 1,000 clouds a second


def test_a_scale_ends_on_a_round_number_and_never_shrinks() -> None:
    assert [top_for(x) for x in (0.0, 0.9e-3, 1.1e-3, 7e-3, 1.0)] == [1e-3, 1e-3, 2e-3, 1e-2, 5e-2]
    assert top_for(1e-3, 5e-3) == 5e-3


TOPICS = {"/organ_deformed", "/organ_rest", "/tool/measured_cp", "/tool/servo_cf"}


def test_rviz_shows_all_of_it_and_is_matched() -> None:
    """Displays named as in RViz 2; a policy that a publisher does not offer hears nothing."""
    displays = yaml.safe_load((PARAMS / "organ.rviz").read_text())["Visualization Manager"][
        "Displays"
    ]
    kinds = {display["Class"].removeprefix("rviz_default_plugins/") for display in displays}
    assert kinds >= {"Marker", "Pose", "Wrench", "TF"}
    topics = {d["Topic"]["Value"]: d["Topic"] for d in displays if "Topic" in d}
    assert topics.keys() == TOPICS
    for name, policy in topics.items():
        (row,) = (row for row in index() if topic(row) == name)
        offered = entry(row["page"], "QoS")
        if row["direction"] == "out" and policy["Reliability Policy"] == "Reliable":
            assert offered.startswith("RELIABLE"), name
        latched = policy["Durability Policy"] == "Transient Local"
        assert latched == ("TRANSIENT_LOCAL" in offered), name


def test_foxglove_shows_all_of_it_under_titles() -> None:
    layout = json.loads((PARAMS / "organ.foxglove.json").read_text())
    text = json.dumps(layout)
    assert all(name in text for name in TOPICS)
    for panel in layout["configById"].values():
        assert panel["foxglovePanelTitle"]  # the key of a title that shows; "title" does not
