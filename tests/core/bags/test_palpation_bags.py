"""Forces of a sensor in a bag, on the path of the tip."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from avatar_core.bags.touched import TouchFile, measured_path
from avatar_core.errors import StorageError
from tests.core.bags.bag_files import PERIOD, Cell, Message, make, only, vector, write_mcap


def test_a_sensor_is_read_rather_than_what_the_cell_computed(cell: Cell, tmp_path: Path) -> None:
    """measured_cf at its own times, its force between two messages; servo_cf where it is alone."""
    computed = cell.messages()
    path = measured_path(TouchFile(write_mcap(tmp_path / "computed.mcap", computed)))
    assert "servo_cf, which the cell computed" in path.notes[-1]
    measured = make("geometry_msgs/msg/Wrench", vector([0.0, 0.0, 2.0]), vector(np.zeros(3)))
    sensed = [
        Message(
            message.received + PERIOD // 3,
            "/tool/measured_cf",
            message.kind,
            make(message.kind, message.content.header, measured),
        )
        for message in only(computed, "servo_cf")
    ]
    path = measured_path(TouchFile(write_mcap(tmp_path / "sensed.mcap", [*computed, *sensed])))
    assert path.notes == ()
    np.testing.assert_allclose(path.force[1:], 2.0)
    np.testing.assert_allclose(path.position, cell.tip, atol=1e-12)


def test_a_bag_without_forces_or_with_gaps(cell: Cell, tmp_path: Path) -> None:
    poses = [*only(cell.messages(), "measured_cp")]
    with pytest.raises(StorageError, match="no /tool/measured_cf and no /tool/servo_cf"):
        measured_path(TouchFile(write_mcap(tmp_path / "poses.mcap", poses)))
    wrenches = [*only(cell.messages(), "servo_cf")]
    gap = [*poses, *wrenches[:100], *wrenches[300:]]
    path = measured_path(TouchFile(write_mcap(tmp_path / "gap.mcap", gap)))
    assert np.isnan(path.force[110:290]).all() and np.isfinite(path.force[310:600]).all()
