"""Files made to do harm: nothing is followed, run or allocated without a check first."""

from __future__ import annotations

import io
import os
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest

from avatar_core.atlas.storage import FRAME, load_atlas
from avatar_core.common.files import FileError, content_of, opened
from avatar_core.errors import AvatarError, StorageError
from avatar_core.geometry.surface import read_surface
from avatar_core.uncertainty.distributions import read_distributions
from avatar_core.vademecum.storage import is_vademecum, load_vademecum, parse_vademecum
from tests.helpers.file_mutations import pristine, sealed

LARGEST = 20e6  # largest allocation for files of 60 kB [bytes]

Change = Callable[[h5py.File], object]


@contextmanager
def allocating_at_most(n_bytes: float) -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < n_bytes
    finally:
        tracemalloc.stop()


def put(key: str, **made: object) -> Change:
    """Return a change that replaces an array."""

    def change(file: h5py.File) -> None:
        del file[key]
        file.create_dataset(key, **made)

    return change


def link(key: str, target: object) -> Change:
    """Return a change that replaces an array or a group by a link."""

    def change(file: h5py.File) -> None:
        del file[key]
        file[key] = target

    return change


def say(key: str, value: object) -> Change:
    """Return a change that replaces an attribute."""
    return lambda file: file.attrs.__setitem__(key, value)


def within_itself(file: h5py.File) -> None:
    del file["far"]
    file["far"] = file["/"]


def virtual(file: h5py.File) -> None:
    shape = file["far/space"].shape
    layout = h5py.VirtualLayout(shape, "f4")
    layout[...] = h5py.VirtualSource("other.h5", "x", shape, "f4")
    del file["far/space"]
    file.create_virtual_dataset("far/space", layout)


BOMB = {"shape": (10**12,), "dtype": "f4", "chunks": (1000,)}
HOSTILE: dict[str, tuple[Change, str]] = {
    "claims 1e12 numbers": (put("far/space", **BOMB), "more data"),
    "claims them compressed": (put("far/space", **BOMB, compression="gzip"), "more data"),
    "claims a product that wraps": (
        put("far/space", shape=(2**32, 2**30), dtype="f4", chunks=(1000, 1000)),
        "more data",
    ),
    "was never written": (put("far/space", shape=(10**12,), dtype="f4"), "more data"),
    "external numbers": (
        put("far/space", shape=(75, 3), dtype="f4", external=[("/etc/passwd", 0, 900)]),
        "outside the file",
    ),
    "virtual numbers": (virtual, "outside the file"),
    "link to a file": (link("far", h5py.ExternalLink("/etc/passwd", "/far")), "only a link"),
    "link to a name": (link("far", h5py.SoftLink("/near")), "only a link"),
    "link to nowhere": (link("far/space", h5py.SoftLink("/nowhere")), "only a link"),
    "link in a circle": (link("far", h5py.SoftLink("/far")), "only a link"),
    "group within itself": (within_itself, "only a link"),
    "array as attribute": (say("name", np.zeros(8000)), "'name' is missing"),
    "text of 20 MB": (say("provenance", "x" * 20_000_000), "letters"),
    "nested JSON": (say("provenance", "[" * 200_000), "cannot be understood"),
    "records": (put("far/space", data=np.zeros((75, 3), "f4,i4")), "plain numbers"),
    "text as numbers": (put("far/space", data=["a", "b"]), "plain numbers"),
    "two lines as name": (say("name", "a\nb"), "printable"),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_structure_is_refused_before_it_is_read(what: str) -> None:
    change, reason = HOSTILE[what]
    altered = io.BytesIO(pristine("vademecum"))
    with h5py.File(altered, "r+") as file:
        change(file)
    content = sealed(altered.getvalue())
    with (
        allocating_at_most(LARGEST + 3 * len(content)),
        pytest.raises(StorageError, match=reason) as caught,
    ):
        parse_vademecum(content, "it")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("read", [load_vademecum, read_surface, read_distributions])
def test_only_ordinary_files_are_opened(tmp_path: Path, read: Callable[[Path], object]) -> None:
    pipe = tmp_path / "pipe.obj"
    os.mkfifo(pipe)  # opening it would wait for a writer
    for path in (pipe, tmp_path, Path("/dev/zero")):
        with pytest.raises(AvatarError, match="not a file"):
            read(path)
    assert not is_vademecum(pipe)


def test_only_ordinary_files_of_an_atlas_are_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / FRAME)
    for path in (tmp_path, tmp_path / FRAME):
        with pytest.raises(AvatarError, match=r"not a file|Not a directory"):
            load_atlas(path)


def test_a_file_is_no_larger_than_allowed(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"x" * 1000)
    with opened(path, 10**10) as source:
        assert len(content_of(source)) == 1000
    with pytest.raises(FileError, match="MB, more than"), opened(path, 999):
        pass


def test_a_file_that_grows_while_it_is_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"x" * 1000)
    with opened(path, 10**10) as source:
        size = os.fstat(source.fileno())
        with path.open("ab") as more:
            more.write(b"y")
        with pytest.MonkeyPatch.context() as patch, pytest.raises(FileError, match="grows"):
            patch.setattr(os, "fstat", lambda number: size)
            content_of(source)
