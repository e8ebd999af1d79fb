"""Orientation of an organ: candidate rotations, and turned surfaces against the phantom."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatar_core.geometry.level_set import candidate_rotations, orientation_offset
from avatar_core.geometry.surface import SurfaceMesh, read_surface


def turned(surface: SurfaceMesh, rotation: np.ndarray) -> SurfaceMesh:
    return replace(surface, vertices=surface.vertices @ rotation.T)


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
UPRIGHT = "Amos-007"  # from another source


def turns(files, phantom):
    """Return the gain of every file, and the names of those that count as turned."""
    offsets = {path.stem: orientation_offset(read_surface(path), phantom) for path in files}
    gains = {name: offset.gain for name, offset in offsets.items()}
    return gains, {name for name, offset in offsets.items() if offset.is_turned}


def test_turned_livers_warn_and_upright_ones_do_not(livers_dir, phantom):
    """One liver of each kind; the long test below covers more."""
    some = sorted(TURNED)[0]
    files = [livers_dir / f"{name}.obj" for name in (some, UPRIGHT)]
    assert turns(files, phantom)[1] == {some}


@pytest.mark.long
def test_only_the_turned_livers_warn(livers_dir, phantom):
    """All turned livers, and every ninth of the others."""
    others = [path for path in sorted(livers_dir.glob("*.obj")) if path.stem not in TURNED]
    files = [*(livers_dir / f"{name}.obj" for name in sorted(TURNED)), *others[::9]]
    gains, turned = turns(files, phantom)
    assert turned == TURNED
    # room on both sides of the threshold 1.15, so that the next liver is judged the same
    assert max(gain for name, gain in gains.items() if name not in turned) < 1.10
    assert min(gains[name] for name in turned) > 1.25
