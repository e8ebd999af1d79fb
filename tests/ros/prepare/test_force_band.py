"""Bands of the force: sent by the loop, prepared for it, and shown on the page.

The loop is stepped by hand; how a running node takes the parameter is in test_uncertainty.
"""

from __future__ import annotations

import json
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from rclpy.serialization import deserialize_message

from avatar_core.contact.force_band import DEPTH, RATIO, ForceBand
from avatar_core.geometry.tip import Tip
from avatar_core.haptics.force_guard import ForceGuard, ForceLimits
from avatar_core.scene.prepare import default_spec
from avatar_core.uncertainty import force_ratios
from avatar_core.uncertainty.distributions import Fixed, Lognormal, Uniform, mappings
from avatar_core.uncertainty.force_ratios import DEPTHS
from avatar_core.uncertainty.known import Held
from avatar_ros.loop.contact_loop import BLEND, ActiveModel
from avatar_ros.loop.safety import Safety, band_topics
from avatar_ros.loop.settings import CHANGEABLE, CONTACT
from avatar_ros.loop.tool_channel import OK, ToolChannel
from avatar_ros.prepare.bands import BandPreparer, usable_known
from tests.helpers.contact import prepare
from tests.helpers.soft_organ import soft_organ
from tests.ros.helpers.refusals import refusal
from tests.ros.helpers.stepped_loop import Queue, SteppedLoop, pose

pytestmark = pytest.mark.long  # it builds organs

TIP = Tip("sphere", 5e-3)
LOW, HIGH = 0.6, 1.7
N_BLEND = round(1e3 * BLEND)


def ratios(data: Any, low: float = LOW, high: float = HIGH) -> np.ndarray:
    shape = (data.model.n_tools, len(data.model.arrays.position), len(DEPTHS), 1)
    return np.concatenate(
        [np.full(shape, np.log(low)), np.full(shape, np.log(high))], axis=-1
    ).astype(np.float32)


class Banded:
    """Bench whose tool has a band, 3 mm deep."""

    def __init__(self, bench: SteppedLoop, touch: Any, safety: Safety | None = None) -> None:
        self.bench, self.loop, queue = bench, bench.loop, bench.poses[0]
        self.edges = [Queue(), Queue()]
        self.tool = ToolChannel(queue, queue, "organ", safety, tuple(self.edges))
        self.tool.band_listeners = 1
        bench.tools[0] = self.tool
        self.loop._tools = bench.tools
        self.tip = bench.press(touch, -1e-3)

    def use(self, organ: Any, identity: str, **band: float) -> None:
        """Use another model, with a band if its ratios are given."""
        data = prepare(organ, (TIP,), cloud="off")
        found = ForceBand(data, ratios(data, **band), DEPTHS) if band else None
        self.loop.active = ActiveModel(identity, data, self.bench.settings, band=found)

    def step(self) -> tuple[np.ndarray, np.ndarray]:
        """Return force and band of the next period."""
        _, force = self.bench.step(pose(self.tip))
        return force, np.array([_force(queue.sent[-1]) for queue in self.edges])


def _force(raw: bytes) -> list[float]:
    force = deserialize_message(raw, WrenchStamped).wrench.force
    return [force.x, force.y, force.z]


@pytest.fixture
def banded(bench: Any, touch: Any, organ: Any) -> Iterator[Banded]:
    made = Banded(bench(20e-3), touch)
    made.use(organ, "a", low=LOW, high=HIGH)
    made.loop._used = made.loop.active
    yield made


# --- the loop ----------------------------------------------------------------------------------


def test_edges_have_stamp_and_frame_of_the_wrench(banded: Banded) -> None:
    force, band = banded.step()
    np.testing.assert_allclose(band, np.outer([LOW, HIGH], force), rtol=1e-6)
    wrench = deserialize_message(banded.bench.poses[0].sent[-1], WrenchStamped)
    assert np.linalg.norm(force) > 0.5
    for queue in banded.edges:
        assert deserialize_message(queue.sent[-1], WrenchStamped).header == wrench.header


def test_nothing_is_sent_without_a_band_or_a_listener(banded: Banded, organ: Any) -> None:
    banded.step()
    n = len(banded.edges[0].sent)
    banded.tool.band_listeners = 0
    banded.step()
    assert len(banded.edges[0].sent) == n
    banded.tool.band_listeners = 1
    banded.use(organ, "a")
    banded.step()
    assert len(banded.edges[0].sent) == n


def test_a_limited_force_has_the_band_of_the_organs(banded: Banded) -> None:
    force, _ = banded.step()
    loop, limits = banded.loop, ForceLimits(0.2, 1e4)
    loop.guards = [ForceGuard(limits)]
    loop.settings = replace(loop.settings, safety=replace(loop.settings.safety, limits=limits))
    for _ in range(300):
        limited, band = banded.step()
    assert np.linalg.norm(limited) == pytest.approx(0.2)
    np.testing.assert_allclose(band, np.outer([LOW, HIGH], force), rtol=1e-6)


def test_without_a_pose_the_band_is_zero(banded: Banded) -> None:
    banded.step()
    for _ in range(25):
        banded.bench.step(None)
    assert [_force(queue.sent[-1]) for queue in banded.edges] == [[0.0] * 3] * 2


def test_the_band_stays_while_the_force_moves_to_another_material(
    banded: Banded, organ: Any
) -> None:
    """Twice the modulus, half the ratios: the force grows within a blend, the band stays."""
    force, band = banded.step()
    stiff = organ.at(young=2.0 * organ.material.young_modulus)
    banded.use(stiff, "a", low=LOW / 2.0, high=HIGH / 2.0)
    for _ in range(N_BLEND // 2):
        half, now = banded.step()
        np.testing.assert_allclose(now, band, rtol=1e-6)
    assert 1.2 < np.linalg.norm(half) / np.linalg.norm(force) < 1.8
    for _ in range(N_BLEND):
        whole, now = banded.step()
    np.testing.assert_allclose(whole, 2.0 * force, rtol=1e-3)
    np.testing.assert_allclose(now, band, rtol=1e-3)


def test_a_band_that_is_asked_for_is_that_of_the_force_that_is_sent(
    bench: Any, touch: Any, organ: Any
) -> None:
    made = Banded(bench(20e-3), touch)
    made.use(organ, "a", low=LOW, high=HIGH)
    for _ in range(N_BLEND + 5):
        force, band = made.step()
        np.testing.assert_allclose(band, np.outer([LOW, HIGH], force), rtol=1e-6)


def test_a_tool_that_stands_elsewhere_gets_the_band_in_its_axes(
    bench: Any, touch: Any, organ: Any
) -> None:
    half = np.sqrt(0.5)
    safety = Safety(frame="device", transform=(0.0, 0.0, 0.0, half, 0.0, 0.0, half))
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    made = Banded(bench(20e-3), touch)
    made.tool = ToolChannel(
        made.bench.poses[0], made.bench.poses[0], "organ", safety, tuple(made.edges)
    )
    made.tool.band_listeners = 1
    made.bench.tools[0] = made.tool
    made.use(organ, "a", low=LOW, high=HIGH)
    made.loop._used = made.loop.active
    for d in [*np.arange(-6e-3, -1e-3, 1e-3), *[-1e-3] * 3]:
        tip = rotation.T @ (touch[0] - d * touch[1])
        status, force = made.bench.step(pose(tip, frame="device"))
        assert status == OK
    band = np.array([_force(queue.sent[-1]) for queue in made.edges])
    np.testing.assert_allclose(band, np.outer([LOW, HIGH], force), rtol=1e-6)
    frame = deserialize_message(made.edges[0].sent[-1], WrenchStamped).header.frame_id
    assert frame == "device"


def test_topics_lie_beside_that_of_the_wrench() -> None:
    assert band_topics("absolute") == ("force_low", "force_high")
    assert band_topics("body") == ("body/force_low", "body/force_high")


def test_sending_a_band_leaves_nothing_behind(banded: Banded) -> None:
    for queue in banded.edges:
        queue.publish_raw = lambda message: None  # type: ignore[method-assign]
    band = banded.loop.active.band
    banded.loop._publish_bands(band)
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(200):
            banded.loop._publish_bands(band)
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 2048


# --- preparation -------------------------------------------------------------------------------

KNOWN = {"young": Lognormal(5e3, 1.4), "poisson": Uniform(0.32, 0.48)}


@pytest.fixture(scope="module")
def soft() -> Any:
    return soft_organ()


def test_a_model_brings_the_arrays_of_its_band(soft: Any) -> None:
    spec = default_spec(soft, (TIP, Tip("sphere", 3e-3), TIP))
    held, arrays, notices = BandPreparer().prepare(spec, mappings(KNOWN))
    n = soft.surface.n_positions
    assert arrays[RATIO].shape == (3, n, len(DEPTHS), 2) and arrays[RATIO].dtype == np.float32
    np.testing.assert_array_equal(arrays[RATIO][0], arrays[RATIO][2])
    assert (arrays[RATIO][..., 0] < arrays[RATIO][..., 1]).all()
    assert not np.allclose(arrays[RATIO][0], arrays[RATIO][1], atol=1e-4)
    np.testing.assert_array_equal(arrays[DEPTH], DEPTHS)
    assert Held.of_plain(held) == Held.by(spec.vademecum) and notices == ()


def test_without_distributions_nothing_is_prepared(
    soft: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(force_ratios, "log_edges", lambda *_: pytest.fail("prepared"))
    monkeypatch.setattr(force_ratios, "log_forces", lambda *_: pytest.fail("prepared"))
    held, arrays, notices = BandPreparer().prepare(default_spec(soft, (TIP,)), {})
    assert arrays == {} and notices == () and held["own"]["poisson"] == soft.material.poisson_ratio


def test_edges_are_found_once_for_a_slider_that_is_dragged(
    soft: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    found: list[int] = []
    own = force_ratios.log_edges
    monkeypatch.setattr(force_ratios, "log_edges", lambda *a: (found.append(1), own(*a))[1])
    preparer, ratio = BandPreparer(), []
    for young in (5e3, 10e3):
        spec = default_spec(soft, (TIP,), values={"young": young})
        ratio.append(preparer.prepare(spec, mappings(KNOWN))[1][RATIO])
    assert len(found) == 1
    np.testing.assert_allclose(ratio[0] - ratio[1], np.log(2.0), atol=1e-5)
    preparer.prepare(default_spec(soft, (TIP,), values={"contrast": 3.0}), mappings(KNOWN))
    assert len(found) == 2  # the contrast has no distribution, and another value now


def test_what_an_organ_has_no_place_for_is_said_and_the_rest_used(organ: Any, soft: Any) -> None:
    given = KNOWN | {"contrast": Uniform(0.1, 3.0)}
    used, notices = usable_known(organ.name, Held.by(organ), given)
    assert used == {"young": KNOWN["young"]}
    assert len(notices) == 2 and "the distribution of poisson is not used in" in notices[0]
    used, notices = usable_known(soft.name, Held.by(soft), given)
    assert used == KNOWN
    assert "which the vademecum holds" in notices[0] and "\n" not in notices[0]
    _, arrays, notices = BandPreparer().prepare(
        default_spec(organ, (TIP,)), mappings({"poisson": KNOWN["poisson"]})
    )
    assert arrays == {} and len(notices) == 1


def test_a_known_value_counts_as_any_other(organ: Any) -> None:
    young = {"young": Fixed(3.0 * organ.material.young_modulus)}
    _, arrays, _ = BandPreparer().prepare(default_spec(organ, (TIP,)), mappings(young))
    np.testing.assert_allclose(arrays[RATIO], np.log(3.0), atol=1e-5)


# --- the node ----------------------------------------------------------------------------------


def test_a_node_does_not_start_with_a_file_that_is_not_there() -> None:
    assert "parameter uncertainty: cannot read" in refusal("contact", "uncertainty:=/no/such.yaml")
    assert "come with avatar" in refusal("contact", "uncertainty:=spleen")


def test_it_starts_though_a_file_of_the_last_run_is_gone(tmp_path: Path) -> None:
    started = {p.name: p.default for p in CONTACT if p.name in CHANGEABLE} | {"scene": ""}
    changed = {"uncertainty": str(tmp_path / "gone.yaml")}
    saved = json.dumps({"started": started, "changed": changed})
    (tmp_path / "contact.json").write_text(saved)
    assert refusal("contact", f"state_dir:={tmp_path}") == ""
