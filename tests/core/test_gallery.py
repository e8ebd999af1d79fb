"""The gallery: each example runs as its page shows it, computes its physics and draws its picture.

``AVATAR_DRAW_GALLERY=1 pytest -m 'long or not long' tests/core/test_gallery.py`` draws the pictures
of the pages anew.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from tests.helpers.page_code import code_of, run
from tests.helpers.paths import ROOT

GALLERY = ROOT / "msg_docs" / "gallery"
LINES, BYTES = 40, 80_000  # of an example, of a picture

Names = dict[str, Any]


def modes(names: Names) -> None:
    """No modes are better than those of the SVD; 11 of the PGD leave less than the paper's."""
    pgd, svd = (np.array(names["errors"][one]) for one in ("PGD", "SVD"))
    assert (np.diff(svd) < 0.0).all()
    assert (svd < 1.01 * pgd).all() and (pgd < 1.5 * svd).all()
    assert pgd[10] < 0.10


def population(names: Names) -> None:
    """Six numbers made the livers, and the new one is theirs."""
    values = names["lle"].eigenvalues_
    assert np.argmax(values[1:] / values[:-1]) + 1 == 6
    assert values[6] > 100 * values[5]
    assert names["worst"] < 4.0  # mm: what the paper's liver 13 is off


def label_map(names: Names) -> None:
    """Voxels, surface, level set and mesh hold the same volume."""
    voxels = names["labels"].sum() * 27e-9
    volumes = [names["organ"].volume, names["grid"].volume, names["v"].mesh.volume]
    np.testing.assert_allclose(volumes, voxels, rtol=0.01)
    assert names["v"].certificate.l2_mean < 0.02


def accuracy(names: Names) -> None:
    """Each budget is kept; a tighter one takes more modes; a full solution takes far longer."""
    points, chosen = names["points"], names["chosen"]
    for tolerance, n_modes in chosen.items():
        assert min(p.l2 for p in points if p.detail.modes <= n_modes) <= tolerance
    assert sorted(chosen.values()) == list(chosen.values()) and len(set(chosen.values())) == 3
    assert names["full"] > 100 * max(p.p50 for p in points)


def patient(names: Names) -> None:
    """More solutions, less error."""
    interpolated, reduced, solved = names["errors"]
    assert 10.0 > interpolated > reduced > solved
    assert reduced < 2.5  # the default tolerance is 2 %
    solutions = [one.solutions for one in names["found"]]
    assert solutions[0] == 0 < solutions[1] < solutions[2]


def effects(names: Names) -> None:
    """Friction adds to the force, a Prony term takes its part, and a held depth is held."""
    force = {name: np.array(values) for name, values in names["force"].items()}
    bare, held = force["bare"], slice(250, 1000)
    assert np.ptp(bare[held]) < 1e-3 * bare[500]
    relaxed = force["viscoelasticity"][999] / bare[999]
    assert 0.6 < relaxed < 0.66  # 1 - g = 0.6, after 2.7 relaxation times
    assert force["friction"][1150] > 1.04 * bare[1150]  # sqrt(1 + 0.3^2) in slip
    assert all(0.0 < cost < 1000.0 for cost in names["cost"].values())


def touches(names: Names) -> None:
    """The interval holds the truth, and less is unknown than before."""
    assert names["low"] < names["truth"] < names["high"]
    assert names["found"].explained
    assert names["high"] / names["low"] < 1.6 < 1.33**3.29  # 90 % of what was known before


def point_cloud(names: Names) -> None:
    """The hidden part is found to the noise of a camera."""
    found, error, hidden = names["found"], names["error"], names["hidden"]
    assert not found.problems
    assert error["After"][hidden].mean() < 2.0 < 5.0 < error["Before"][hidden].mean()


QUICK = (population,)
LONG = (modes, label_map, accuracy, patient, effects, touches, point_cloud)


@pytest.mark.parametrize(
    "check",
    [*QUICK, *(pytest.param(check, marks=pytest.mark.long) for check in LONG)],
    ids=lambda check: check.__name__,
)
def test_an_example_computes_and_draws_what_its_page_says(
    check: Callable[[Names], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = check.__name__
    check(run(GALLERY / f"{name}.md", tmp_path, monkeypatch))
    drawn = tmp_path / f"{name}.png"
    assert drawn.stat().st_size < BYTES
    assert np.ptp(matplotlib.image.imread(drawn)) > 0.5  # no blank sheet
    if os.environ.get("AVATAR_DRAW_GALLERY"):
        notes = PngImagePlugin.PngInfo()
        notes.add_text("code", digest(GALLERY / f"{name}.md"))
        Image.open(drawn).save(GALLERY / f"{name}.png", pnginfo=notes, optimize=True)


def digest(page: Path) -> str:
    """Return the digest of a page's code, which its picture carries."""
    return hashlib.sha256(code_of(page).encode()).hexdigest()[:16]


def test_every_page_is_short_tried_and_shows_its_picture() -> None:
    pages = sorted(GALLERY.glob("*.md"))
    assert {page.stem for page in pages} == {check.__name__ for check in (*QUICK, *LONG)}
    for page in pages:
        assert len(code_of(page).splitlines()) <= LINES, page.name
        assert f"]({page.stem}.png)" in page.read_text()
        picture = page.with_suffix(".png")
        assert 5_000 < picture.stat().st_size < BYTES
        with Image.open(picture) as image:
            assert image.info.get("code") == digest(page), f"draw {picture.name} anew"
