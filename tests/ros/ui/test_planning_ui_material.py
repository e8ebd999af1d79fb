"""The planning page of an organ with a tumour: its sliders are felt, and it is seen through."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")
pytest.importorskip("viser", reason="viser is not installed: pip install '.[ui]'")
pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")

import meshio
from rcl_interfaces.srv import GetParameters
from rclpy.parameter import parameter_value_to_python

from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.tumour import read_tumour
from avatar_core.offline.pipeline import OrganOptions, build
from avatar_core.offline.rule import BuildRule
from avatar_core.reduction.coordinates import Coordinate
from avatar_core.vademecum.storage import save_vademecum
from avatar_ros.srv import LoadVademecum
from tests.helpers.disk_cache import cached_on_disk
from tests.helpers.small_files import ball
from tests.ros.conftest import PATIENT, Probe
from tests.ros.helpers.browser import (
    CHROMIUM,
    TOKEN,
    force_of,
    free_port,
    input_of,
    nodes_of_a_page,
    open_tab,
    opened,
    pressed,
    shots_in,
    until,
)

pytestmark = [
    pytest.mark.ros,
    pytest.mark.long,  # an organ with coordinates is solved first
    pytest.mark.timing,  # a browser that draws without a graphics card takes both cores
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: apt install chromium"),
]

CHOSEN_BY_ANOTHER = 150e3  # Young's modulus [Pa], as the contact node is started
BALL = 0.018  # radius of the tumour [m]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A library with a coarse phantom over Poisson's ratio and the contrast of a tumour."""
    folder = tmp_path_factory.mktemp("tumour")
    for name, content in _library().items():
        (folder / name).write_bytes(content)
    return folder


@cached_on_disk
def _library() -> dict[str, bytes]:
    liver = phantom_liver(12e-3)
    center = liver.vertices.mean(axis=0) + np.array([0.0, 0.03, 0.0])
    points, faces = ball(360, BALL)
    with TemporaryDirectory() as name:
        tumour, organ = Path(name, "tumour.stl"), Path(name, "liver.h5")
        meshio.write_points_cells(tumour, 1e3 * (center + points), {"triangle": faces})
        contrast = Coordinate("contrast", 0.5, 20.0, 3)
        options = OrganOptions(
            n_vertices=600,
            rule=BuildRule(max_modes=20),
            coordinates=(Coordinate("poisson", 0.40, 0.49, 2), contrast),
            tumour=read_tumour(tumour),
            n_certified=4,
        )
        save_vademecum(build(liver, options), organ)
        healthy = Path(name, "healthy.h5")
        options = OrganOptions(n_vertices=600, rule=BuildRule(max_modes=20), n_certified=4)
        save_vademecum(build(replace(liver, name="healthy"), options), healthy)
        return {file.name: file.read_bytes() for file in (organ, healthy)}


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return shots_in(tmp_path_factory.mktemp("shots"))


@pytest.fixture(scope="module")
def page(folder: Path, own_domain: dict[str, str], shots: Path) -> Iterator[Any]:
    library, port = ["-p", f"library_dir:={folder}"], free_port()
    arguments = {
        "vademecum_loader": [*library, "-p", "vademecum:=liver.h5"],
        "contact": [*PATIENT[1:], "-p", f"material.young_modulus:={CHOSEN_BY_ANOTHER}"],
        "planning_ui": [*library, "-p", f"port:={port}", "-p", f"token:={TOKEN}"],
    }
    with nodes_of_a_page(arguments, own_domain), opened(port, shots) as page:
        yield page


def in_force(probe: Probe, name: str) -> float:
    request = GetParameters.Request(names=[f"material.{name}"])
    (value,) = probe.ask(GetParameters, "/contact/get_parameters", request).values
    return float(parameter_value_to_python(value))


def vermilion(page: Any, shot: Path) -> np.ndarray:
    """Pixels of the tumour, not of tissue, (n, 2): down, right."""
    from PIL import Image

    page.screenshot(path=shot)
    left = np.asarray(Image.open(shot).convert("RGB"))[:, :900].astype(float)
    red, green, blue = np.moveaxis(left, 2, 0)
    return np.argwhere((red > 1.5 * green) & (red > 2.6 * blue))  # tissue is twice as red as blue


def test_a_tumour_is_seen_in_the_organ(page: Any, shots: Path) -> None:
    page.wait_for_timeout(2000)
    assert len(vermilion(page, shots / "tumour.png")) > 500


def test_what_another_client_chose_is_shown(page: Any) -> None:
    open_tab(page, "Organ")
    shown = input_of(page, "E [kPa]")
    until(page, lambda: shown.input_value() == f"{CHOSEN_BY_ANOTHER / 1e3:g}", "the value", 30.0)


@pytest.mark.parametrize(
    ("label", "name", "value", "unit"),
    [
        ("E [kPa]", "young_modulus", 300.0, 1e3),
        ("nu [-]", "poisson_ratio", 0.42, 1.0),
        ("Tumour / E [-]", "contrast", 15.0, 1.0),
    ],
)
def test_a_slider_is_felt(
    page: Any, shots: Path, lasting_probe: Probe, label: str, name: str, value: float, unit: float
) -> None:
    pressed(page)
    open_tab(page, "Organ")
    before = force_of(page)
    box = input_of(page, label)
    box.fill(f"{value:g}")
    box.press("Enter")
    until(
        page,
        lambda: abs(in_force(lasting_probe, name) / (unit * value) - 1.0) < 0.02,
        f"{name} of the contact node",
        30.0,
    )
    change = 0.2 if name == "young_modulus" else 0.005
    until(page, lambda: abs(force_of(page) - before) > change, "another force", 30.0)
    page.screenshot(path=shots / f"{name}.png")


def test_no_tumour_is_drawn_in_an_organ_without_one(
    page: Any, shots: Path, lasting_probe: Probe
) -> None:
    """Last, as it changes the organ."""
    request = LoadVademecum.Request(name="healthy.h5")
    assert lasting_probe.ask(LoadVademecum, "load_vademecum", request).success
    page.get_by_text("healthy", exact=False).first.wait_for(timeout=30e3)
    until(page, lambda: len(vermilion(page, shots / "healthy.png")) == 0, "no tumour", 30.0)
    request = LoadVademecum.Request(name="liver.h5")
    assert lasting_probe.ask(LoadVademecum, "load_vademecum", request).success
    until(page, lambda: len(vermilion(page, shots / "again.png")) > 500, "the tumour again", 30.0)
