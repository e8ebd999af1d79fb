"""Names from the network: ordinary files inside the library; one line refuses the others."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from avatar_core.errors import one_line
from avatar_interfaces.msg import VademecumFile
from avatar_interfaces.srv import InterpolatePatient
from avatar_ros.framework import conversions, library
from avatar_ros.framework.library import RefusedError, file_name, find_in_library, read_in_library
from avatar_ros.framework.reader import Reader
from avatar_ros.nodes.patient_interpolation import patient_request
from avatar_ros.patients.builder import BuildError
from avatar_ros.patients.worker import require_replaceable
from avatar_ros.prepare.protocol import Channel, Refused
from avatar_ros.prepare.requests import PreparationRequest
from avatar_ros.prepare.worker import ModelPreparer


@pytest.fixture
def shelf(tmp_path: Path) -> Path:
    """Fill a library with one file and links out."""
    folder = tmp_path / "library"
    (folder / "sub").mkdir(parents=True)
    (folder / "a.h5").write_bytes(b"inside")
    (folder / "sub" / "b.h5").write_bytes(b"below")
    (tmp_path / "secret").write_bytes(b"outside")
    (folder / "out").symlink_to(tmp_path / "secret")
    (folder / "up").symlink_to("..")
    (folder / "in").symlink_to("a.h5")
    (folder / "round").symlink_to("round")
    (folder / "zero").symlink_to("/dev/zero")
    os.mkfifo(folder / "pipe")
    return folder


BAD = {
    "": "no file name",
    "/etc/passwd": "inside library_dir",
    "../secret": "inside library_dir",
    "sub/../../secret": "inside library_dir",
    "out": "link out",
    "up/secret": "link out",
    "zero": "link out",
    "round": "links to itself|symbolic links",
    "pipe": "not a file",
    "sub": "not a file",
    ".": "not a file",
    "none": "No such file",
    "a.h5\n[INFO] all is well": "printable",
    "a\0b": "printable",
    "\x1b[2J": "printable",
    "x" * 2000: "printable",
    "x" * 500: "File name too long",
}


@pytest.mark.parametrize("read", [find_in_library, read_in_library])
@pytest.mark.parametrize("name", BAD, ids=[repr(name)[:20] for name in BAD])
def test_a_name_that_leads_elsewhere_is_refused(
    shelf: Path, name: str, read: Callable[..., Any]
) -> None:
    with pytest.raises(RefusedError, match=BAD[name]) as caught:
        read(name, str(shelf), 100)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_names_inside_are_found(shelf: Path) -> None:
    assert read_in_library("a.h5", str(shelf), 6) == b"inside"
    assert read_in_library("sub/b.h5", str(shelf), 100) == b"below"
    assert find_in_library("in", str(shelf), 100) == (shelf / "a.h5").resolve()
    with pytest.raises(RefusedError, match="raise max_megabytes"):
        read_in_library("a.h5", str(shelf), 5)


def test_a_library_that_is_changed_meanwhile_leads_nowhere(
    shelf: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The name becomes a link out between the check and the opening."""
    true = library.opened

    def swapped(path: Path, max_bytes: int) -> Any:
        path.unlink()
        path.symlink_to(shelf.parent / "secret")
        return true(path, max_bytes)

    monkeypatch.setattr(library, "opened", swapped)
    with pytest.raises(RefusedError, match="led out of library_dir"):
        read_in_library("a.h5", str(shelf), 100)


@pytest.mark.parametrize("name", ["../x", "/x", ".x", "x" * 201, "a\nb", "a\0b"])
def test_a_result_has_a_plain_name(name: str) -> None:
    with pytest.raises(RefusedError):
        file_name(name)
    assert file_name("x") == file_name("x.h5") == "x.h5"


def test_nothing_but_a_vademecum_is_replaced(shelf: Path, library: Path) -> None:
    reader = Reader(1 << 20)
    require_replaceable(shelf / "new.h5", reader)
    require_replaceable(library / "liver.h5", reader)
    (shelf / "link.h5").symlink_to(library / "liver.h5")
    (shelf / "nowhere.h5").symlink_to("/nowhere/at/all")
    for name in ("a.h5", "sub", "pipe", "link.h5", "nowhere.h5"):
        with pytest.raises(BuildError, match="choose another name"):
            require_replaceable(shelf / name, reader)
    reader.close()


def test_two_labels_of_one_file_are_two_patients(shelf: Path) -> None:
    settings: Any = SimpleNamespace(library_dir=str(shelf), max_bytes=1 << 20)
    written = set()
    for file, label in (("1.2.17.nii", "1"), ("1.2.17.nii", "2"), ("1.2.18.nii", "a/b")):
        (shelf / file).write_bytes(b"#")
        request = InterpolatePatient.Request(surface=file, label=label)
        written.add(Path(patient_request(request, settings).output).name)
    assert written == {
        "1.2.17-1-interpolated.h5",
        "1.2.17-2-interpolated.h5",
        "1.2.18-a_b-interpolated.h5",
    }


def test_a_large_mesh_is_refused_before_it_is_copied(
    shelf: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = InterpolatePatient.Request()
    request.mesh = conversions.surface_mesh(*_triangles(1000))
    settings: Any = SimpleNamespace(library_dir=str(shelf), max_bytes=36_000)
    order = patient_request(request, settings)
    assert order.vertices is not None and order.vertices.shape == (1000, 3)

    def never(mesh: Any) -> Any:
        raise AssertionError("copied")

    monkeypatch.setattr(conversions, "mesh_arrays", never)
    settings.max_bytes = 35_999
    with pytest.raises(RefusedError, match="raise max_megabytes"):
        patient_request(request, settings)


def _triangles(n: int) -> tuple[Any, Any]:
    import numpy as np

    return np.zeros((n, 3)), np.zeros((n, 3), dtype=np.int64)


def test_an_answer_is_one_short_line() -> None:
    assert one_line(ValueError("a\n b\t c")) == "a b c"
    assert one_line(ValueError()) == "ValueError"
    assert one_line(ValueError("\x1b[31m")) == "?[31m"
    assert len(one_line(ValueError("x" * 10_000))) == 500


def test_a_forged_vademecum_with_a_long_name_is_refused_in_one_packet() -> None:
    """The refusal goes through a socket that takes some 200 kB; the worker has to survive it."""
    ours, theirs = Channel.pair()
    request = PreparationRequest("vademecum", "n", "/", (0.005,), None, "surface", 1e-3)
    with ours, theirs:
        ModelPreparer(request, Channel(theirs)).receive(
            VademecumFile(id="0" * 64, name="x\n" * 1_000_000, data=b"no file")
        )
        received = Channel(ours).receive()
    assert received is not None and isinstance(received[0], Refused)
    reason = received[0].reason
    assert "refused" in reason and "\n" not in reason and len(reason) < 1000
