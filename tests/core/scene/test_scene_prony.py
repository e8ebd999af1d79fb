"""Prony terms from a table beside the scene."""

from __future__ import annotations

from pathlib import Path

import pytest

from avatar_core.errors import SceneError
from avatar_core.scene.file import parse_scene, read_scene, write_scene
from avatar_core.scene.yaml_lines import MAX_BYTES
from tests.helpers.scene_cases import PRONY


def prony_scene(folder: Path, name: str = "prony.csv") -> Path:
    path = folder / "scene.yaml"
    path.write_text(f"name: a\neffects:\n  viscoelasticity:\n    file: {name}\n")
    return path


@pytest.mark.parametrize(
    "table",
    [
        "0.3,0.5\n0.25,8\n",
        "g,tau\n0.3,0.5\n0.25,8\n",
        "\ufeffG [-], tau [s]\r\n0.3 , 0.5\r\n\r\n2.5e-1, 8 # slow\r\n",
        "# of the order found in literature\ng,tau\n0.3,0.5\n0.25,8",
    ],
)
def test_prony_terms_come_from_a_file_beside_the_scene(tmp_path: Path, table: str) -> None:
    (tmp_path / "prony.csv").write_bytes(table.encode())
    scene = read_scene(prony_scene(tmp_path))
    assert scene.effects == (PRONY,)
    assert parse_scene(write_scene(scene), "service") == scene  # which has no folder


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        ("", "prony.csv:1: holds no term"),
        ("g,tau\n", "prony.csv:1: holds no term"),
        ("tau,g\n0.5,0.3\n", "prony.csv:1: g is 'tau'"),
        ("0.3,0.5\ng,tau\n", "prony.csv:2: g is 'g'"),
        ("0.3\n", "prony.csv:1: 1 columns"),
        ("0.3,0.5\n0.3,0.5,1\n", "prony.csv:2: 3 columns"),
        ("g,tau\n-0.3,0.5\n", "prony.csv:2: g is '-0.3'; it must be a number in 0 to 0.999"),
        ("g,tau\n0.3,0\n", "prony.csv:2: tau is '0'; it must be a number in 0.001 to 100000 s"),
        ("0.3,nan\n", "tau is 'nan'"),
        ("0.3,x\n", "tau is 'x'"),
        ("0.1,1\n" * 7, "7 g and 7 tau"),
        pytest.param("#" * MAX_BYTES + "#", "at most 65536", id="long"),
    ],
)
def test_a_bad_table_is_one_line_with_both_places(tmp_path: Path, table: str, reason: str) -> None:
    (tmp_path / "prony.csv").write_text(table)
    with pytest.raises(SceneError) as caught:
        read_scene(prony_scene(tmp_path))
    assert reason in str(caught.value)
    line = 3 if "7 g" in reason else 4  # of the effect, where the terms are good one by one
    assert str(caught.value).startswith(f"{tmp_path}/scene.yaml:{line}: ")
    assert "\n" not in str(caught.value)


def test_a_scene_reads_nothing_outside_its_folder(tmp_path: Path) -> None:
    inside = tmp_path / "scenes"
    inside.mkdir()
    outside = tmp_path / "prony.csv"
    outside.write_text("0.3,0.5\n")
    (inside / "link.csv").symlink_to(outside)
    (inside / "loop.csv").symlink_to(inside / "loop.csv")
    for name in ("../prony.csv", str(outside), "link.csv", "../scenes2/x.csv"):
        with pytest.raises(SceneError, match=r"scene\.yaml:4: .*in the folder of the scene"):
            read_scene(prony_scene(inside, name))
    for name in ("none.csv", "loop.csv"):
        with pytest.raises(SceneError, match=r"scene\.yaml:4: .*cannot be read"):
            read_scene(prony_scene(inside, name))
    with pytest.raises(SceneError, match="is not a file"):
        read_scene(prony_scene(inside, "."))


def test_terms_come_from_one_place(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("effects:\n  viscoelasticity:\n    g: [0.3]\n    tau: [1]\n    file: p.csv\n")
    with pytest.raises(SceneError, match=r"scene\.yaml:5: viscoelasticity has file and g, tau"):
        read_scene(path)
