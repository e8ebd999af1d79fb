"""Gaps beside an organ's label in a label map: lesions cut out of it, cavities, borders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest

from avatar_core.geometry.surface import SurfaceMesh, read_surface
from tests.helpers.known_surfaces import refused

SIZE = 4.0  # size of voxels [mm]
N = 40  # along each axis
RADIUS = 60.0  # radius of the organ, about the middle of the map [mm]


def ball(radius: float, *centre: float) -> np.ndarray:
    """Return voxels of a ball about a place [mm] from the middle of the map."""
    place = SIZE * (np.stack(np.meshgrid(*[np.arange(N)] * 3, indexing="ij"), -1) - (N - 1) / 2)
    return np.linalg.norm(place - centre, axis=-1) < radius


def written(path: Path, *bodies: np.ndarray, cut: Any = ()) -> Path:
    """Write bodies with labels from 1 on, each over those before; cut : part of the map to keep."""
    values = np.zeros((N, N, N), np.uint8)
    for label, body in enumerate(bodies, 1):
        values[body] = label
    nibabel.save(nibabel.Nifti1Image(values[cut], np.diag([SIZE, SIZE, SIZE, 1.0])), path)
    return path


def said(surface: SurfaceMesh, words: str) -> list[str]:
    return [notice for notice in surface.notices if words in notice]


LIVER = ball(RADIUS, 0, 0, 0)
ORGAN = LIVER.sum() * (1e-3 * SIZE) ** 3  # [m^3]
INNER = ball(20, 15, 0, 10)
EDGE = ball(20, 0, 45, 0)  # two thirds of its surface touch the organ
AWAY = ball(20, 0, 0, 65)  # a fifth of it lies in the organ


@pytest.mark.parametrize("lesion", [INNER, EDGE])
def test_a_lesion_that_was_cut_out_of_the_organ_belongs_to_it(tmp_path, lesion):
    path = written(tmp_path / "a.nii", LIVER, lesion)
    whole = read_surface(path, label=1, inside=("2",))
    union = read_surface(path, label="1, 2")
    assert whole.volume == pytest.approx(union.volume, rel=1e-9)
    assert whole.volume >= ORGAN * 0.99 and said(whole, "hollow") == said(union, "hollow") == []
    assert "inside: 100%" in whole.notices[0] and "label 1 + 2" in union.notices[0]


def test_an_organ_with_a_hole_that_another_label_fills_is_refused(tmp_path):
    path = written(tmp_path / "a.nii", LIVER, INNER, ball(10, -25, 0, 0))
    refused(
        path, "label 1, 879 ml, is hollow", "label 2 (34 ml), label 3", "--label 1,2,3", label=1
    )
    refused(path, "of it: label 3 (4.1 ml); ", "(--tumour-label 3)", label="1,2")
    assert said(read_surface(path, label="1,2,3"), "hollow") == []


def test_a_label_at_the_border_of_the_organ_that_was_cut_out_of_it_is_said(tmp_path):
    path = written(tmp_path / "a.nii", LIVER, EDGE)
    (notice,) = said(read_surface(path, label=1), "hollow")
    assert notice.startswith("label 2, 3") and "label after a comma" in notice


def test_a_lesion_beside_the_organ_does_not_belong_to_it(tmp_path):
    path = written(tmp_path / "a.nii", AWAY, LIVER)
    surface = read_surface(path, label=2, inside=("1",))
    assert surface.volume == pytest.approx(ORGAN, rel=0.01)
    assert "inside: 0%" in surface.notices[0] and said(surface, "hollow") == []


@pytest.mark.parametrize(("radius", "is_whole"), [(17, True), (12, False)])
def test_a_lesion_with_a_gap_around_it_lies_inside(tmp_path, radius, is_whole):
    """It fills its cavity if it takes half of that."""
    hole = ball(20, 0, 0, 0)
    path = written(tmp_path / "a.nii", LIVER & ~hole, ball(radius, 0, 0, 0))
    surface = read_surface(path, label=1, inside=("2",))
    assert "inside: 100%" in surface.notices[0]
    assert (surface.volume > 0.99 * ORGAN) == is_whole
    assert len(said(surface, "a cavity of")) == (not is_whole)
    refused(path, "out of it: label 2 (", label=1)


def test_a_cavity_that_no_label_fills_is_said(tmp_path):
    path = written(tmp_path / "a.nii", LIVER & ~INNER)
    (notice,) = said(read_surface(path), "cavity")
    assert "33 ml that no label fills" in notice or "34 ml that no label fills" in notice


def test_an_organ_of_several_labels_is_their_union(tmp_path):
    left, right = LIVER.copy(), LIVER.copy()
    left[N // 2 :], right[: N // 2] = False, False
    path = written(tmp_path / "a.nii", left, right, INNER)
    whole = read_surface(path, label="1,2,3")
    assert whole.volume == pytest.approx(ORGAN, rel=0.01) and len(whole.notices) == 1
    refused(path, "labels present: 1, 2, 3; choose with --label", label="1,4")
    refused(path, "without names", label="1,liver")


@pytest.mark.parametrize("margin", [0, 3])  # voxels on the other sides: cropped to it, or not
def test_an_organ_cut_off_by_the_border_of_its_image_is_said(tmp_path, margin):
    used = np.flatnonzero(LIVER.any(axis=(0, 1)))
    low, high = used[0] - margin, used[-1] + 1 + margin
    around = (slice(low, high), slice(low, high))
    whole = read_surface(written(tmp_path / "whole.nii", LIVER, cut=(*around, slice(low, high))))
    assert len(whole.notices) == 1
    touches = written(tmp_path / "touches.nii", LIVER, cut=(*around, slice(low, high - margin)))
    assert len(read_surface(touches).notices) == 1
    path = written(tmp_path / "cut.nii", LIVER, cut=(*around, slice(low, high - margin - 5)))
    surface = read_surface(path)
    (notice,) = said(surface, "the image ends inside the organ")
    assert "superior side" in notice and "cm2" in notice


def test_a_label_of_one_voxel_has_no_surface(tmp_path):
    values = np.zeros((9, 9, 9), np.uint8)
    values[4, 4, 4] = 1
    nibabel.save(nibabel.Nifti1Image(values, np.eye(4)), tmp_path / "a.nii")
    refused(tmp_path / "a.nii", "label 1, 0.001 ml, is too small")
