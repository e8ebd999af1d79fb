"""Files of an atlas that were changed, cut or replaced are refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from avatar_core.atlas.anatomy import WholeAnatomy
from avatar_core.atlas.frame import Frame
from avatar_core.atlas.model import Atlas
from avatar_core.atlas.storage import FRAME, LEVEL_SET, SHAPE, load_atlas, n_bytes
from avatar_core.errors import AvatarError, StorageError
from tests.core.atlas.rough import written


@pytest.fixture
def copy(folder: Path, tmp_path: Path) -> Path:
    """Copy an atlas, to damage it."""
    return Path(shutil.copytree(folder, tmp_path / "atlas"))


def read_all(folder: Path) -> Atlas:
    atlas = load_atlas(folder)
    assert [atlas.read_distances(one).shape for one in atlas.anatomies]
    return atlas


def test_other_schemas_are_refused(copy: Path) -> None:
    with h5py.File(copy / FRAME, "r+") as stored:
        stored.attrs["schema"] = "3.0"
    with pytest.raises(StorageError, match="upgrade avatar"):
        load_atlas(copy)


@pytest.mark.parametrize(
    "key", [f"liver1/{LEVEL_SET}:distances", f"liver1/{SHAPE}:registered", f"{FRAME}:template/tets"]
)
def test_one_bit_is_noticed(copy: Path, key: str) -> None:
    name, _, array = key.partition(":")
    with h5py.File(copy / name, "r") as stored:
        offset = stored[array].id.get_offset()
    content = bytearray((copy / name).read_bytes())
    content[offset + 8] ^= 1
    (copy / name).write_bytes(content)
    with pytest.raises(StorageError, match=r"checksum.*again"):
        read_all(copy)


def test_other_files_are_refused(copy: Path, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="avatar atlas create"):
        load_atlas(tmp_path / "nowhere")
    shape = copy / "liver1" / SHAPE
    shape.write_bytes(shape.read_bytes()[:-5000])
    with pytest.raises(StorageError, match=r"truncated.*add its surface again"):
        load_atlas(copy)
    with h5py.File(copy / FRAME, "w") as stored:
        stored.attrs["format"] = "avatar vademecum"
    with pytest.raises(StorageError, match="HDF5 but no atlas"):
        load_atlas(copy)
    with pytest.raises(StorageError, match=r"an atlas is a folder.*avatar atlas create"):
        load_atlas(copy / FRAME)  # an atlas of earlier versions was a file


def test_the_level_set_of_another_anatomy_is_refused(copy: Path) -> None:
    shutil.copy(copy / "liver2" / LEVEL_SET, copy / "liver1" / LEVEL_SET)
    with pytest.raises(StorageError, match="belongs to another anatomy"):
        read_all(copy)


def test_an_anatomy_is_removed_with_its_folder(copy: Path, atlas: Atlas) -> None:
    before = n_bytes(copy)
    shutil.rmtree(copy / "liver1")
    assert set(atlas.names) - set(read_all(copy).names) == {"liver1"} and n_bytes(copy) < before


@pytest.mark.parametrize(
    ("file", "key", "spoil"),
    [
        (LEVEL_SET, "distances", lambda a: a[:-1]),
        (LEVEL_SET, "distances", lambda a: a * np.nan),
        (SHAPE, "registered", lambda a: a[:-1]),
        (FRAME, "template/tets", lambda a: a + 10**6),
        (FRAME, "template/clamped", lambda a: a[:-1]),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    frame: Frame,
    members: list[WholeAnatomy],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    file: str,
    key: str,
    spoil: Callable[[np.ndarray], np.ndarray],
) -> None:
    from avatar_core.common import hdf5

    encoded = hdf5.encoded

    def spoiled(arrays: dict[str, np.ndarray], *others: Any) -> memoryview:
        return encoded(
            {name: spoil(a) if name == key else a for name, a in arrays.items()}, *others
        )

    monkeypatch.setattr(hdf5, "encoded", spoiled)  # with a correct checksum
    with pytest.raises(AvatarError, match=r"again|atlas|surface"):
        written(tmp_path / "atlas", frame, members[:1])
        read_all(tmp_path / "atlas")
