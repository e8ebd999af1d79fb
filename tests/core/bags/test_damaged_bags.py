"""Bags that are cut, damaged or false are read as far as possible, or refused in one line."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from rosbags.rosbag2 import Reader

from avatar_core.bags.periods import path_of
from avatar_core.bags.read import read_bag
from avatar_core.errors import AvatarError, StorageError
from avatar_core.scene.file import write_scene
from avatar_core.scene.model import Scene
from avatar_core.vademecum.model import Vademecum
from tests.core.bags.bag_files import PERIOD, Cell, write_mcap, write_rosbag

pytestmark = pytest.mark.long  # it simulates a cell

Spoil = Callable[[bytes], bytes]


def cut(part: float) -> Spoil:
    return lambda content: content[: int(part * len(content))]


def zeros(n: int | None = None) -> Spoil:
    """Return a change that zeroes n bytes from the middle on."""

    def spoil(content: bytes) -> bytes:
        middle = len(content) // 2
        end = len(content) if n is None else middle + n
        return content[:middle] + bytes(end - middle) + content[end:]

    return spoil


@pytest.mark.parametrize(
    ("spoil", "least", "most", "note"),
    [
        (cut(0.3), 0.05, 1.0, "was not closed: all but its last"),
        (cut(0.6), 0.35, 1.0, "was not closed: all but its last"),
        (cut(0.95), 0.7, 1.0, "was not closed: all but its last"),
        # as after a power failure; the last chunk is half zero
        (zeros(), 0.2, 0.6, "was not closed"),
        (zeros(2000), 0.2, 0.7, "damaged after"),
    ],
    ids=["cut early", "cut late", "cut at its end", "ends in zeros", "damaged chunk"],
)
def test_a_spoilt_file_is_read_as_far_as_it_goes(
    spoil: Spoil, least: float, most: float, note: str, whole: Path, cell: Cell, tmp_path: Path
) -> None:
    file = tmp_path / "spoilt.mcap"
    file.write_bytes(spoil(whole.read_bytes()))
    bag = read_bag(file)
    n = len(bag.poses)
    assert least * len(cell.stamp) < n <= most * len(cell.stamp)
    np.testing.assert_array_equal(bag.poses.values[:, :3], cell.tip[:n])
    assert bag.wrenches is not None
    np.testing.assert_array_equal(bag.wrenches.values, cell.sent[: len(bag.wrenches)])
    assert len(bag.notes) == 1 and note in bag.notes[0]


def test_two_topics_out_of_order_in_a_file_that_was_not_closed(cell: Cell, tmp_path: Path) -> None:
    messages = cell.messages()
    swapped = [one for pair in zip(messages[1::2], messages[::2], strict=True) for one in pair]
    file = write_mcap(tmp_path / "swapped.mcap", swapped)
    file.write_bytes(file.read_bytes()[:-3000])
    bag = read_bag(file)
    np.testing.assert_array_equal(bag.poses.values[:, :3], cell.tip[: len(bag.poses)])
    assert len(bag.poses) > 0.7 * len(cell.stamp)


def test_a_folder_without_metadata(cell: Cell, tmp_path: Path) -> None:
    messages = cell.messages()
    folder = tmp_path / "bag"
    folder.mkdir()
    for i in (2, 10):  # the files of one recording
        part = messages[:800] if i == 2 else messages[800:]
        write_mcap(folder / f"bag_{i}.mcap", part)
    bag = read_bag(folder)
    np.testing.assert_array_equal(bag.poses.values[:, :3], cell.tip)
    assert bag.notes == (f"{folder} has no metadata.yaml; its files are read one by one",)


@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
@pytest.mark.parametrize("compression", ["MESSAGE", "FILE"])
def test_a_compressed_bag_without_metadata(
    plugin: str, compression: str, cell: Cell, tmp_path: Path
) -> None:
    """Metadata are missing; a single file alone is read, too."""
    folder = write_rosbag(tmp_path / "bag", cell.messages(), plugin, 9, compression)
    (folder / "metadata.yaml").unlink()
    (file,) = folder.iterdir()
    for path in (folder, file):
        np.testing.assert_array_equal(read_bag(path).poses.values[:, :3], cell.tip)


def test_a_file_that_the_metadata_list_is_missing(cell: Cell, tmp_path: Path) -> None:
    folder = write_rosbag(tmp_path / "bag", cell.messages())
    held = yaml.safe_load((folder / "metadata.yaml").read_text())
    held["rosbag2_bagfile_information"]["relative_file_paths"].append("bag_1.mcap")
    (folder / "metadata.yaml").write_text(yaml.safe_dump(held))
    bag = read_bag(folder)
    assert len(bag.poses) == len(cell.stamp)
    assert bag.notes == (f"1 of the 2 files of {folder} are missing",)


@pytest.mark.parametrize("back", [200 * PERIOD, 200 * PERIOD + 300_000])
@pytest.mark.parametrize("chunks", [True, False])
def test_a_clock_that_is_set_back(
    back: int, chunks: bool, organ: Vademecum, cell: Cell, tmp_path: Path
) -> None:
    """The clock jumps in the middle of a push; stamps repeat, or do not."""
    moved = replace(cell, stamp=cell.stamp - back * (np.arange(len(cell.stamp)) >= 400))
    messages, bag = moved.messages(), tmp_path / "bag"
    if chunks:
        bag = write_mcap(tmp_path / "bag.mcap", messages, chunk_size=1 << 14)
    else:
        write_rosbag(bag, messages)
    read = read_bag(bag)
    assert [note for note in read.notes if "was set back by 0.2 s: times of" in note]
    path = path_of(read, write_scene(Scene()), organ.id)
    np.testing.assert_array_equal(path.recording.periods.tip[:, 0], cell.tip)
    np.testing.assert_array_equal(path.recording.periods.force[:, 0], cell.sent)


@pytest.mark.parametrize("plugin", ["MCAP", "SQLITE3"])
def test_metadata_that_names_another_quality_of_service(
    plugin: str, cell: Cell, tmp_path: Path
) -> None:
    """Some bags of rosbag2 itself have this; the library alone reads nothing of them."""
    bag = write_rosbag(tmp_path / "bag", cell.messages(), plugin, 8)
    held = yaml.safe_load((bag / "metadata.yaml").read_text())
    qos = "- {history: 3, depth: 0, reliability: 1, durability: 2, deadline: {sec: 1, nsec: 0}, "
    qos += "lifespan: {sec: 1, nsec: 0}, liveliness: 1, liveliness_lease_duration: {sec: 1, nsec: "
    qos += "0}, avoid_ros_namespace_conventions: false}"
    for topic in held["rosbag2_bagfile_information"]["topics_with_message_count"]:
        topic["topic_metadata"]["offered_qos_profiles"] = qos
    (bag / "metadata.yaml").write_text(yaml.safe_dump(held))
    with Reader(bag) as reader:
        assert not list(reader.messages())
    assert len(read_bag(bag).poses) == len(cell.stamp)


def test_metadata_that_is_damaged(cell: Cell, tmp_path: Path) -> None:
    bag = write_rosbag(tmp_path / "bag", cell.messages())
    (bag / "metadata.yaml").write_text("rosbag2_bagfile_information: {version: [")
    assert len(read_bag(bag).poses) == len(cell.stamp)


@pytest.mark.parametrize("garbage", ["text", "half", "short"])
def test_sqlite_that_is_damaged_is_refused(garbage: str, cell: Cell, tmp_path: Path) -> None:
    file = next(write_rosbag(tmp_path / "bag", cell.messages(), "SQLITE3").glob("*.db3"))
    content = file.read_bytes()
    spoilt = {"text": b"no database" * 99, "half": content[: len(content) // 2], "short": b""}
    file.write_bytes(spoilt[garbage])
    for path in (file, tmp_path / "bag"):
        with pytest.raises(
            StorageError, match=r"no readable bag.*sqlite3 FILE \.recover"
        ) as caught:
            read_bag(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("closed", [True, False])
def test_sizes_that_lie(closed: bool, whole: Path, cell: Cell, tmp_path: Path) -> None:
    """A chunk, its content and the header claim more bytes than there are."""
    content = bytearray(whole.read_bytes())
    chunk = content.index(b"\x06", 8 + 9)
    while struct.unpack_from("<Q", content, chunk + 1)[0] > len(content):
        chunk = content.index(b"\x06", chunk + 1)
    for offset, size in ((chunk + 1, 1 << 62), (chunk + 9 + 16, 1 << 60), (9, 1 << 40)):
        lying = content.copy()
        struct.pack_into("<Q", lying, offset, size)
        file = tmp_path / "lying.mcap"
        file.write_bytes(lying if closed else lying[:-100])
        try:
            bag = read_bag(file)
        except StorageError as error:
            assert "\n" not in str(error)
        else:  # the index tells the truth
            assert closed
            np.testing.assert_array_equal(bag.poses.values[:, :3], cell.tip[: len(bag.poses)])
            assert len(bag.poses) == len(cell.stamp) or "damaged" in bag.notes[0]


@pytest.mark.parametrize("suffix", [".mcap", ".db3"])
def test_random_damage_never_ends_in_a_traceback(suffix: str, cell: Cell, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    plugin = "MCAP" if suffix == ".mcap" else "SQLITE3"
    messages = cell.messages()[:300]
    content = next(write_rosbag(tmp_path / "bag", messages, plugin).glob(f"*{suffix}")).read_bytes()
    file, outcomes = tmp_path / f"spoilt{suffix}", set()
    for _ in range(150):
        spoilt = bytearray(content)
        where = rng.integers(0, len(spoilt), 1 + rng.integers(0, 20))
        for i in where:
            spoilt[i] = rng.integers(0, 256)
        file.write_bytes(spoilt[: rng.integers(len(spoilt) // 2, len(spoilt) + 1)])
        try:
            path_of(read_bag(file), write_scene(Scene()), "")
            outcomes.add("read")
        except AvatarError as error:
            assert "\n" not in str(error)
            outcomes.add("refused")
    assert outcomes == {"read", "refused"} or suffix == ".db3"


def test_what_is_no_bag(tmp_path: Path) -> None:
    for name, match in (
        ("none", "there is no bag"),
        ("old.bag", "a bag of ROS 1; convert it"),
        ("half.db3.zstd", "no readable bag"),
        ("bag.txt", "give the bag's folder"),
    ):
        if "." in name:
            (tmp_path / name).write_bytes(b"x")
        with pytest.raises(StorageError, match=match):
            read_bag(tmp_path / name)
    (tmp_path / "folder").mkdir()
    with pytest.raises(StorageError, match=r"holds no \.mcap or \.db3"):
        read_bag(tmp_path / "folder")
