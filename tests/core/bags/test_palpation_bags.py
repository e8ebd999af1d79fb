"""Sensor forces in a bag, on the path of the tip."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from avatar_core.bags.touched import TouchFile, measured_path
from avatar_core.errors import StorageError
from tests.core.bags.bag_files import (
    PERIOD,
    START,
    WRENCH,
    Cell,
    Message,
    header,
    make,
    only,
    vector,
    write_mcap,
)

WRENCH_ONLY = "geometry_msgs/msg/Wrench"


def test_a_sensor_is_read_rather_than_what_the_cell_computed(cell: Cell, tmp_path: Path) -> None:
    """measured_cf is used at its own times, interpolated; servo_cf only without measured_cf."""
    computed = cell.messages()
    path = measured_path(TouchFile(write_mcap(tmp_path / "computed.mcap", computed)))
    assert "servo_cf, which the cell computed" in path.notes[-1]
    times, rising = np.arange(len(cell.stamp)), 2.0 + 1e-3 * np.arange(len(cell.stamp))
    sensed = [
        Message(at, "/tool/measured_cf", WRENCH, make(WRENCH, header(at, "sensor"), measured))
        for at, measured in (
            (stamp + PERIOD // 3, make(WRENCH_ONLY, vector([0.0, 0.0, z]), vector(np.zeros(3))))
            for stamp, z in zip(cell.stamp.tolist(), rising, strict=True)
        )
    ]
    path = measured_path(TouchFile(write_mcap(tmp_path / "sensed.mcap", [*computed, *sensed])))
    assert path.notes == ()
    np.testing.assert_allclose(path.force[1:], np.interp(times[1:], times + 1 / 3, rising))
    np.testing.assert_allclose(path.position, cell.tip, atol=1e-12)


def test_a_bag_without_forces_or_with_gaps(cell: Cell, tmp_path: Path) -> None:
    poses = [*only(cell.messages(), "measured_cp")]
    with pytest.raises(StorageError, match="no /tool/measured_cf and no /tool/servo_cf"):
        measured_path(TouchFile(write_mcap(tmp_path / "poses.mcap", poses)))
    wrenches = [*only(cell.messages(), "servo_cf")]
    gap = [*poses, *wrenches[:100], *wrenches[300:]]
    path = measured_path(TouchFile(write_mcap(tmp_path / "gap.mcap", gap)))
    assert np.isnan(path.force[110:290]).all() and np.isfinite(path.force[310:600]).all()


@pytest.mark.parametrize("late", [10, 20, 50, 100])
def test_forces_that_are_received_late_are_those_of_their_stamps(
    late: int, cell: Cell, tmp_path: Path
) -> None:
    """Where stamps do not tell times, e.g. because they repeat, the time of receipt does."""
    messages = sensed(cell, late * PERIOD)
    path = measured_path(TouchFile(write_mcap(tmp_path / "late.mcap", messages)))
    np.testing.assert_allclose(path.vector, cell.force, atol=1e-9)
    np.testing.assert_allclose(path.time, 1e-3 * np.arange(len(cell.stamp)), atol=1e-9)
    assert path.notes == ()
    for other in (0, START, START + 3_600_000_000_000):
        messages = sensed(cell, late * PERIOD, other)
        path = measured_path(TouchFile(write_mcap(tmp_path / f"{other}.mcap", messages)))
        np.testing.assert_allclose(path.vector[late:], cell.force[:-late], atol=1e-9)
        assert path.notes == (
            "stamps do not tell when poses and forces were measured: times of receipt are taken",
        )


def sensed(cell: Cell, late: int, other: int | None = None) -> list[Message]:
    """Return poses and late sensor forces, with their own stamps or another one.

    Forces also come after the end of the recording, and by the clock of another machine.
    """
    found = [*only(cell.messages(), "measured_cp")]
    for k, stamp in enumerate(cell.stamp.tolist()):
        said = stamp if other is None else other + (stamp - START) * (other > START)
        wrench = make(WRENCH_ONLY, vector(cell.force[k]), vector(np.zeros(3)))
        content = make(WRENCH, header(said, "sensor"), wrench)
        found.append(Message(stamp + late, "/tool/measured_cf", WRENCH, content))
    return found
