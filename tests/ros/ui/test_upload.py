"""Files that a browser sends: checked, limited in size, and never replacing another."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from viser import UploadedFile, ViserServer

from avatar_core.errors import AvatarError
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from avatar_ros.framework.reader import Reader
from avatar_ros.ui.scan import upload
from avatar_ros.ui.server.index_page import MOST_SENT
from tests.helpers.box_organ import organ
from tests.ros.helpers.page import Noted, image

OFF = "OFF\n4 4 0\n0 0 0\n100 0 0\n0 100 0\n0 0 100\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def sent(tmp_path: Path) -> dict[str, bytes]:
    """Return valid files by name."""
    own = tmp_path / "own"
    own.mkdir()
    save_vademecum(organ("cube"), own / "cube.h5")
    image(own / "ct.nii.gz", np.arange(27, dtype=np.int16).reshape(3, 3, 3))
    (own / "liver.OFF").write_text(OFF)
    return files(own)


@pytest.fixture(scope="module")
def reader() -> Iterator[Reader]:
    made = Reader(1 << 28)
    yield made
    made.close()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "library").mkdir()
    return tmp_path / "library"


def test_what_is_sound_is_in_the_library(
    folder: Path, reader: Reader, sent: dict[str, bytes]
) -> None:
    said: list[str] = []
    for name, content in sent.items():
        upload.receive(folder, reader, said.append, name, content)
        assert said[-2:] == [f"checking {name} ...", f"{name} is in the library"]
    assert files(folder) == sent
    assert load_vademecum(folder / "cube.h5").name == "cube"


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("cube.h5", lambda good: good[: len(good) // 2], "not stored: cube.h5 is no readable"),
        ("ct.nii.gz", lambda good: good[: len(good) // 2], "not stored: ct.nii.gz"),
        ("liver.OFF", lambda good: b"OFF\n", "not stored: liver.OFF"),
        ("recording-1.h5", lambda good: b"", "not stored: recording-1.h5 is no readable"),
        ("notes.txt", lambda good: good, "neither organ nor image"),
        ("../cube.h5", lambda good: good, "no path"),
        (".cube.h5", lambda good: good, "no leading dot"),
    ],
)
def test_what_is_not_is_refused_in_a_line(
    folder: Path, reader: Reader, sent: dict[str, bytes], name: str, content: Any, reason: str
) -> None:
    good = sent.get(name, sent["cube.h5"])
    with pytest.raises(AvatarError, match=reason) as refusal:
        upload.store(folder, reader, name, content(good))
    assert str(folder) not in str(refusal.value) and not files(folder)


def test_no_file_replaces_another(folder: Path, reader: Reader, sent: dict[str, bytes]) -> None:
    (folder / "cube.h5").write_bytes(b"mine")
    with pytest.raises(AvatarError, match="in the library already"):
        upload.store(folder, reader, "cube.h5", sent["cube.h5"])

    def read(name: str, n_bytes: int, check: Any, path: Path) -> None:
        (folder / "liver.OFF").write_bytes(b"theirs")  # comes meanwhile

    with pytest.raises(AvatarError, match="in the library already"):
        upload.store(folder, Noted(read=read), "liver.OFF", b"ours")  # type: ignore[arg-type]
    assert files(folder) == {"cube.h5": b"mine", "liver.OFF": b"theirs"}


def test_a_file_that_is_too_large_is_not_even_received(server: ViserServer) -> None:
    button = server.gui.add_upload_button("Send")
    upload.bound(server)
    gui: Any = server.gui
    (start,) = gui._websock_interface._incoming_handlers[upload.FileTransferStartUpload]
    for size in (MOST_SENT, MOST_SENT + 1):
        start(0, upload.FileTransferStartUpload(button._impl.uuid, str(size), "a.h5", "", 9, size))
    assert list(gui._current_file_upload_states) == [str(MOST_SENT)]
    gui._current_file_upload_states.clear()


def test_a_file_that_was_taken_is_not_kept_in_memory(server: ViserServer) -> None:
    button = server.gui.add_upload_button("Send")
    button._impl.value = UploadedFile("a.h5", b"content")
    assert upload.take(button) == ("a.h5", b"content")
    assert button.value == UploadedFile("", b"")
