"""Foreign bags are replayed like our recordings, and others read the bags that we write."""

from __future__ import annotations

import json
import sqlite3
import sys
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from avatar_core.bags import table, types
from avatar_core.bags.compare import comparable
from avatar_core.bags.periods import BagPath, path_of
from avatar_core.bags.read import read_bag
from avatar_core.bags.write import write_mcap as export
from avatar_core.contact.effects import Friction, Viscoelasticity
from avatar_core.contact.status import PLACED
from avatar_core.errors import StorageError
from avatar_core.haptics.force_guard import DEVICES, ForceLimits
from avatar_core.scene.file import write_scene
from avatar_core.scene.model import Scene
from avatar_core.scene.recording import Clouds, Periods, Recording, save_recording
from avatar_core.scene.replay import Replayed, replay
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import save_vademecum
from tests.core.bags import bag_files
from tests.core.bags.bag_files import (
    PERIOD,
    POSE,
    STATE,
    STORE,
    Cell,
    Message,
    info,
    only,
    renamed,
    write_mcap,
    write_rosbag,
)
from tests.core.conftest import Command

pytestmark = pytest.mark.long  # it builds organs and simulates a cell

SAME = 1e-9  # tolerance of equal forces [N]
SCENE = write_scene(Scene())
Writer = Callable[[Path, Iterable[Message]], Path]


def replayed(
    path: Path, organ: Vademecum, limits: ForceLimits = DEVICES["sigma"], **how: Any
) -> tuple[BagPath, Replayed]:
    """Return a bag's path and its replay, as the command makes them."""
    bag = read_bag(path, how.pop("tool", None))
    scene = how.pop("scene", SCENE)
    found = path_of(bag, scene, organ.id, **how)
    return found, comparable(found, replay(found.recording, organ), limits)


def rosbag(plugin: str, version: int = 9, compression: str = "NONE") -> Writer:
    return lambda folder, messages: write_rosbag(
        folder / "bag", messages, plugin, version, compression
    )


def single(suffix: str, plugin: str) -> Writer:
    def write(folder: Path, messages: Iterable[Message]) -> Path:
        return next(write_rosbag(folder / "bag", messages, plugin).glob(f"*{suffix}"))

    return write


def by_mcap(compression: CompressionType) -> Writer:
    return lambda folder, messages: write_mcap(folder / "bag.mcap", messages, compression)


WRITERS = {
    "sqlite3-v8": rosbag("SQLITE3", 8),
    "sqlite3-v9": rosbag("SQLITE3"),
    "sqlite3-messages": rosbag("SQLITE3", 9, "MESSAGE"),
    "sqlite3-file": rosbag("SQLITE3", 9, "FILE"),
    "db3": single(".db3", "SQLITE3"),
    "mcap-v8": rosbag("MCAP", 8),
    "mcap-v9": rosbag("MCAP"),
    "mcap-chunks": rosbag("MCAP", 9, "STORAGE"),
    "mcap": single(".mcap", "MCAP"),
    "mcap-lz4": by_mcap(CompressionType.LZ4),
    "mcap-zstd": by_mcap(CompressionType.ZSTD),
    "mcap-none": by_mcap(CompressionType.NONE),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS.keys())
def test_forces_of_a_cell_are_the_same(
    write: Writer, organ: Vademecum, cell: Cell, tmp_path: Path
) -> None:
    path, found = replayed(write(tmp_path, cell.messages()), organ)
    periods = path.recording.periods
    np.testing.assert_array_equal(periods.tip[:, 0], cell.tip)
    np.testing.assert_array_equal(periods.force[:, 0], cell.sent)
    np.testing.assert_array_equal(periods.stamp, cell.stamp)
    assert path.answers == "wrenches" and path.recording.rate == 1000.0
    touching = np.linalg.norm(cell.force, axis=1) > 0.1
    assert found.known[touching].mean() > 0.95
    assert found.difference(path.recording) <= SAME


def test_the_computed_forces_are_compared_where_states_are_recorded(
    organ: Vademecum, cell: Cell, tmp_path: Path
) -> None:
    """Forces that the guard faded in or limited are compared, too."""
    cut = slice(240, None)  # the force comes while it is faded in
    kept = {k: v[cut] for k, v in vars(cell).items() if k not in ("vademecum_id", "orientation")}
    weak = Cell(cell.vademecum_id, **kept)
    weak.sent = 0.5 * weak.force
    path, found = replayed(write_rosbag(tmp_path / "bag", weak.messages(states=True)), organ)
    assert path.answers == "states" and found.known.all()
    np.testing.assert_array_equal(path.recording.periods.force[:, 0], weak.force)
    assert found.difference(path.recording) <= SAME
    np.testing.assert_array_equal(path.recording.periods.sent_fraction[:, 0], weak.share)


def test_states_of_version_0_2_are_read(
    organ: Vademecum, cell: Cell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their type belonged to avatar_ros, and messages ended before ``held``."""
    whole = STORE.serialize_cdr

    def shorter(message: Any, kind: str) -> Any:
        content = whole(message, kind)
        return content[:-1] if kind == STATE else content

    monkeypatch.setattr(STORE, "serialize_cdr", shorter)
    bag = single(".db3", "SQLITE3")(tmp_path, cell.messages(states=True))
    monkeypatch.undo()
    with closing(sqlite3.connect(bag)) as file, file:
        file.execute("UPDATE topics SET type = replace(type, 'avatar_interfaces', 'avatar_ros')")
        file.execute("DELETE FROM message_definitions")
    path, found = replayed(bag, organ)
    assert path.answers == "states" and found.difference(path.recording) <= SAME


def test_forces_that_a_limit_altered_are_not_compared(organ: Vademecum, tmp_path: Path) -> None:
    weak = ForceLimits(1.0, 40.0)
    cell = bag_files.simulated_cell(organ, limits=weak)
    altered = (cell.sent != cell.force).any(axis=1)
    assert 100 < altered.sum() < 500
    bag = write_rosbag(tmp_path / "bag", cell.messages())
    path, found = replayed(bag, organ, weak)
    assert not found.known[altered].any()
    assert found.known[170:270].all() and found.known[400:440].all()
    assert found.difference(path.recording) <= SAME
    path, found = replayed(bag, organ)
    assert found.difference(path.recording) > 0.5


def test_a_pose_that_is_too_old_is_no_pose(organ: Vademecum, cell: Cell, tmp_path: Path) -> None:
    """The tool falls silent on the organ: its force is faded out, and stays zero."""
    messages = cell.messages()[:680]  # until it presses
    last = messages[-1]
    zero = bag_files.vector(np.zeros(3))
    nothing = bag_files.make("geometry_msgs/msg/Wrench", zero, zero)
    for k in range(1, 200):
        wrench = last.content if k < 20 else replace(last.content, wrench=nothing)
        messages.append(replace(last, received=last.received + k * PERIOD, content=wrench))
    path, found = replayed(write_rosbag(tmp_path / "bag", messages), organ)
    assert np.linalg.norm(path.recording.periods.force[339, 0]) > 0.1
    assert (path.recording.periods.tip[365:] == 1e3).all()
    np.testing.assert_array_equal(path.recording.periods.tip[340:355, 0] - cell.tip[339], 0.0)
    assert found.known[200:340].all() and found.difference(path.recording) <= SAME


def test_poses_alone_give_forces(organ: Vademecum, cell: Cell, tmp_path: Path) -> None:
    poses = only(cell.messages(), "measured_cp")
    path, found = replayed(write_mcap(tmp_path / "poses.mcap", poses), organ)
    assert path.answers == "poses" and not found.known.any()
    np.testing.assert_allclose(found.force[:, 0], cell.force, atol=SAME)


# --- recordings as bags -----------------------------------------------------------------------


VISCOUS = Viscoelasticity(g=(0.3,), tau=(0.1,))


def recorded(organ: Vademecum, effects: tuple[Any, ...], turning: bool = False) -> Recording:
    """Return a recording as the planning page makes it, with a failed pose and lost periods."""
    cell = bag_files.simulated_cell(organ, effects)
    n = len(cell.stamp)
    turn = np.clip(np.arange(n) - 400, 0, 100)[:, None] * [0.0, 2e-3, 1e-3] * turning
    orientation = Rotation.from_rotvec(turn).as_quat()[:, None]
    tip = cell.tip[:, None].copy()
    status = cell.status[:, None].astype(np.uint8)
    stamp = cell.stamp.copy()
    tip[700:], status[700:], stamp[700:] = 1e3, 3, stamp[699]  # STALE_POSE
    made = Recording(
        organ.id,
        organ.name,
        write_scene(Scene(effects=effects)),
        1000.0,
        True,
        Periods(
            number=np.arange(n) + 100,
            stamp=stamp,
            tip=tip,
            orientation=orientation,
            status=status,
            force=np.zeros((n, 1, 3)),
            error=np.full((n, 1), 0.02),
            sent_fraction=np.where(np.arange(n) % 7, 1.0, 0.5)[:, None],
        ),
        Clouds(np.array([100]), np.zeros((1, 7, 3), np.float32)),
    )
    made.periods.force[:] = replay(made, organ).force
    kept = {key: np.delete(value, slice(720, 725), 0) for key, value in vars(made.periods).items()}
    return replace(made, periods=Periods(**kept))


@pytest.mark.parametrize(
    ("effects", "turning"),
    [
        pytest.param((), False, id="elastic"),
        pytest.param((VISCOUS,), False, id="viscous", marks=pytest.mark.long),
        pytest.param((Friction(),), True, id="friction", marks=pytest.mark.long),
    ],
)
def test_a_recording_written_as_mcap_is_replayed_as_it_was(
    effects: tuple[Any, ...], turning: bool, organ: Vademecum, tmp_path: Path
) -> None:
    made = recorded(organ, effects, turning)
    export(made, tmp_path / "made.mcap")
    bag = read_bag(tmp_path / "made.mcap")
    assert bag.about is not None and bag.vademecum_ids == (organ.id,)
    path = path_of(bag, bag.about.scene, organ.id)
    read = path.recording
    assert (read.scene, read.rate, read.from_rest) == (made.scene, made.rate, True)
    before, after = vars(made.periods), vars(read.periods)
    np.testing.assert_array_equal(np.diff(after["number"]), np.diff(before["number"]))
    placed = np.isin(before["status"], PLACED) & np.isfinite(before["tip"]).all(axis=2)
    np.testing.assert_array_equal(after["orientation"][placed], before["orientation"][placed])
    assert not after["orientation"][~placed].any()
    for name in ("stamp", "tip", "status", "force", "error", "sent_fraction"):
        np.testing.assert_array_equal(after[name], before[name], err_msg=name)
    found, expected = replay(read, organ), replay(made, organ)
    np.testing.assert_array_equal(found.known, expected.known)
    assert found.known[:700].all() and found.difference(read) <= SAME


def test_others_read_what_we_write(organ: Vademecum, tmp_path: Path) -> None:
    made = recorded(organ, ())
    export(made, tmp_path / "made.mcap")
    p = made.periods
    read: dict[str, list[Any]] = {}
    with (tmp_path / "made.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages():
            read.setdefault(channel.topic, []).append((message.log_time, content))
        summary = reader.get_summary()
    assert summary is not None and summary.statistics is not None
    assert summary.statistics.message_count == sum(map(len, read.values()))
    poses, wrenches = read["/tool/measured_cp"], read["/tool/servo_cf"]
    assert len(poses) == 700 and len(wrenches) == len(read["/contact_state"]) == len(p)
    for k, (_, pose) in enumerate(poses):
        assert pose.header.frame_id == "organ" and stamp_of(pose) == p.stamp[k]
        position = pose.pose.position
        assert [position.x, position.y, position.z] == p.tip[k, 0].tolist()
        assert pose.pose.orientation.w == 1.0
    times = [time for time, _ in wrenches]
    assert np.diff(times).min() == PERIOD and np.diff(times).max() == 6 * PERIOD
    for k, (_, wrench) in enumerate(wrenches):
        sent = p.force[k, 0] * p.sent_fraction[k, 0]
        force = wrench.wrench.force
        assert [force.x, force.y, force.z] == sent.tolist() and stamp_of(wrench) == p.stamp[k]
    for k, (_, state) in enumerate(read["/contact_state"]):
        assert (state.tool, state.vademecum_id) == ("tool", organ.id)
        assert state.status == p.status[k, 0] and state.force_share == p.sent_fraction[k, 0]
    ((_, about),) = read["/recording"]
    assert json.loads(about.data)["scene"] == made.scene


def stamp_of(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec * 1_000_000_000 + stamp.nanosec)


def test_an_export_that_fails_leaves_the_file_that_was_there(
    organ: Vademecum, tmp_path: Path
) -> None:
    made, file = recorded(organ, ()), tmp_path / "made.mcap"
    file.write_text("mine")
    short = replace(made.periods, orientation=made.periods.orientation[:100])
    with pytest.raises(IndexError):
        export(replace(made, periods=short), file)
    assert file.read_text() == "mine" and list(tmp_path.iterdir()) == [file]


# --- variants of bags -------------------------------------------------------------------------


def test_messages_in_any_order_and_twice(organ: Vademecum, cell: Cell, tmp_path: Path) -> None:
    messages = cell.messages()
    shuffled = [messages[i] for i in np.random.default_rng(1).permutation(len(messages))]
    twice = write_rosbag(tmp_path / "bag", [*shuffled, *messages[500:600]])
    path, found = replayed(twice, organ)
    np.testing.assert_array_equal(path.recording.periods.force[:, 0], cell.sent)
    assert len(path.recording.periods) == len(cell.stamp)
    assert found.difference(path.recording) <= SAME


@pytest.mark.parametrize(
    ("effects", "n", "lost"), [((), 3, 0), ((), 30, 30), ((VISCOUS,), 3, 3), ((VISCOUS,), 1, 1)]
)
def test_gaps_are_lost_periods_if_they_matter(
    effects: tuple[Any, ...], n: int, lost: int, organ: Vademecum, cell: Cell, tmp_path: Path
) -> None:
    """Elastic forces do not depend on the lost periods."""
    stamps = cell.stamp[300 : 300 + n].tolist()
    messages = [
        one
        for one in cell.messages()
        if not (one.topic.endswith("servo_cf") and stamp_of(one.content) in stamps)
    ]
    bag = write_rosbag(tmp_path / "bag", messages)
    path, found = replayed(bag, organ, scene=write_scene(Scene(effects=effects)))
    assert len(path.recording.periods) == len(cell.stamp) - n
    assert path.recording.periods.lost.sum() == lost
    if not effects:
        assert found.known[260:290].all() and found.known[350:450].all() == (lost == 0)
        assert found.difference(path.recording) <= SAME


def test_a_long_gap_in_which_the_tip_rests_loses_nothing(
    organ: Vademecum, cell: Cell, tmp_path: Path
) -> None:
    """The computed forces are compared: they do not depend on the force guard."""
    later = [
        replace(one, received=one.received + 50 * PERIOD * (one.received > int(cell.stamp[320])))
        for one in cell.messages(states=True)
    ]
    path, found = replayed(write_rosbag(tmp_path / "bag", later), organ)
    assert not path.recording.periods.lost.any() and found.known.all()
    wrenches = [one for one in later if one.topic != "/contact_state"]
    path, found = replayed(write_rosbag(tmp_path / "wrenches", wrenches), organ)
    assert path.recording.periods.lost.sum() == 50 and not found.known[320:380].any()


def test_answers_to_lost_poses_are_left_out(organ: Vademecum, cell: Cell, tmp_path: Path) -> None:
    lost = cell.stamp[500:503].tolist()
    messages = [
        one
        for one in cell.messages()
        if not (one.topic.endswith("measured_cp") and stamp_of(one.content) in lost)
    ]
    path, found = replayed(write_rosbag(tmp_path / "bag", messages), organ)
    assert path.notes == ("3 wrenches answer poses that the bag lacks: left out",)
    assert path.recording.periods.lost.sum() == 3 and not found.known[503:600].any()
    assert found.known[260:480].all() and found.difference(path.recording) <= SAME


def test_poses_that_the_loop_refused(organ: Vademecum, cell: Cell, tmp_path: Path) -> None:
    """A wrench after a refused pose may be fading out."""
    messages = cell.messages()
    nan = bag_files.vector([np.nan] * 3, "Point")
    turn = bag_files.vector([0.0, 0.0, 0.0, 1.0], "Quaternion")
    pose = bag_files.make("geometry_msgs/msg/Pose", nan, turn)
    at = int(cell.stamp[400]) + PERIOD // 10
    content = bag_files.make(POSE, bag_files.header(at, "organ"), pose)
    elsewhere = replace(messages[0].content, header=bag_files.header(at + 1, "world"))
    spoilt = [
        Message(at, "/tool/measured_cp", POSE, content),
        Message(at + 1, "/tool/measured_cp", POSE, elsewhere),
    ]
    path, found = replayed(write_rosbag(tmp_path / "bag", [*messages, *spoilt]), organ)
    assert "1 poses are invalid: refused, as by the loop" in path.notes
    assert any("1 poses are in other frames than 'organ'" in note for note in path.notes)
    assert found.known[370:389].all() and not found.known[395:530].any()
    assert found.known[580:].any()


@pytest.mark.parametrize("axes", ["servo_cf", "body/servo_cf", "spatial/servo_cf"])
def test_frames_of_devices(axes: str, organ: Vademecum, cell: Cell, tmp_path: Path) -> None:
    """Poses and forces are in a device's frame, somewhere in the organ's."""
    base = Rotation.from_rotvec([0.3, -1.1, 0.4])
    origin = np.array([0.02, 0.3, -0.1])
    gripper = Rotation.from_rotvec([1.0, 0.2, 0.1])
    sent = base.inv().apply(cell.sent)
    if axes.startswith("body"):
        sent = gripper.inv().apply(sent)
    moved = replace(
        cell,
        tip=base.inv().apply(cell.tip - origin),
        sent=sent,
        orientation=np.repeat(gripper.as_quat()[None], len(cell.stamp), 0),
    )
    messages = renamed(moved.messages("/MTML", "MTML_base"), "servo_cf", axes)
    bag = write_rosbag(tmp_path / "bag", messages)
    with pytest.raises(StorageError, match=r"in the frame 'MTML_base'.*give --tool-transform"):
        replayed(bag, organ)
    path, found = replayed(bag, organ, transform=(*origin, *base.as_quat()))
    assert found.known.mean() > 0.5 and found.difference(path.recording) <= SAME
    np.testing.assert_allclose(path.recording.periods.tip[:, 0], cell.tip, atol=1e-12)


def test_one_tool_of_several(organ: Vademecum, cell: Cell, tmp_path: Path) -> None:
    left, right = cell.messages("/cell/left", states=True), cell.messages("/cell/right")
    messages = [*left, *right, info("1" * 64)]
    bag = write_rosbag(tmp_path / "bag", renamed(messages, "/contact_state", "/cell/contact_state"))
    with pytest.raises(StorageError, match=r"several tools.*--tool.*/cell/left/measured_cp"):
        read_bag(bag)
    with pytest.raises(StorageError, match=r"no tool 'middle'; choose.*/cell/right/servo_cf"):
        read_bag(bag, "middle")
    for name in ("left", "cell/left", "/cell/left"):
        assert read_bag(bag, name).tool == "/cell/left"
    assert read_bag(bag, "left").states is not None
    assert read_bag(bag, "left").vademecum_ids == (organ.id,)  # the other is no topic of /cell


def test_topics_that_do_not_fit(cell: Cell, tmp_path: Path) -> None:
    messages = cell.messages()
    wrong = [replace(m, kind=bag_files.WRENCH, content=messages[1].content) for m in messages[:2]]
    with pytest.raises(StorageError, match=r"no NAME/measured_cp of.*PoseStamped; it has.*Wrench"):
        read_bag(write_rosbag(tmp_path / "wrong", wrong))
    with pytest.raises(StorageError, match="it has no topics"):
        read_bag(write_rosbag(tmp_path / "empty", []))
    other = [messages[0], replace(messages[0], topic="/tool/servo_cf")]
    bag = read_bag(write_rosbag(tmp_path / "other", other))
    assert bag.wrenches is None and "is of geometry_msgs/msg/PoseStamped" in bag.notes[0]
    nothing = write_rosbag(tmp_path / "nothing", [replace(messages[0], received=5)])
    with pytest.raises(StorageError, match="measured_cp is empty"):
        bag = read_bag(nothing)
        path_of(replace(bag, poses=bag.poses.where(np.zeros(1, bool))), SCENE, "")


def test_bounded_memory(monkeypatch: pytest.MonkeyPatch, cell: Cell, tmp_path: Path) -> None:
    monkeypatch.setattr(table, "MAX_MESSAGES", 100)
    with pytest.raises(StorageError, match="more than 100 messages in a topic; cut the bag"):
        read_bag(write_rosbag(tmp_path / "bag", cell.messages()))


def test_our_types_are_those_of_the_nodes() -> None:
    for name, definition in bag_files.own_types().items():
        assert types.typestore().fielddefs[name][1] == definition[1], name


# --- the commands -----------------------------------------------------------------------------


def test_the_commands(avatar: Command, organ: Vademecum, cell: Cell, tmp_path: Path) -> None:
    save_vademecum(organ, tmp_path / "liver.h5")
    replay_of = partial(avatar, "replay", "--vademecum", tmp_path / "liver.h5")
    bag = write_rosbag(tmp_path / "bag", [info(organ.id), *cell.messages()])
    code, said, _ = replay_of(bag)
    assert code == 0 and "is unknown" not in said
    assert "compared with the wrenches" in said and "largest difference 0.00e+00 N" in said
    poses = write_mcap(tmp_path / "poses.mcap", only(cell.messages(), "measured_cp"))
    code, said, _ = replay_of(poses)
    assert code == 0
    assert "no forces in the bag" in said and "whether it was made with this" in said
    other = write_rosbag(tmp_path / "other", [info("f" * 64), *cell.messages()])
    for arguments, reason in (
        ((other,), "made with the vademecum ffffffffffff"),
        ((bag, "--scene", "needle_probe"), "--scene, --tool-transform and --device of the cell"),
        ((bag, "--scene", "two_tools"), "give a scene of one tool"),
        ((bag, "--scene", "relaxation"), "which viscoelasticity remembers"),
        ((bag, "--tool-transform", "1,2"), "seven numbers"),
    ):
        code, _, err = replay_of(*arguments)
        assert code == 1 and reason in err
    save_recording(recorded(organ, ()), tmp_path / "made.h5")
    made = tmp_path / "made.mcap"
    code, said, _ = avatar("export", tmp_path / "made.h5", "-o", made)
    assert code == 0 and "without 1 clouds" in said
    assert avatar("export", tmp_path / "made.h5", "-o", made)[0] == 1
    assert avatar("export", tmp_path / "made.h5", "-o", made, "--overwrite")[0] == 0
    code, said, _ = replay_of(made)
    assert code == 0 and "compared with the computed forces" in said


def test_without_the_extra(
    monkeypatch: pytest.MonkeyPatch, organ: Vademecum, whole: Path, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "rosbags", None)
    for needs in (
        lambda: read_bag(whole),
        lambda: export(recorded(organ, ()), tmp_path / "a.mcap"),
    ):
        with pytest.raises(StorageError, match=r"pip install '\.\[bags\]'"):
            needs()
