"""A file that was changed, cut or is of another kind is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from avatar_core.atlas.model import Atlas
from avatar_core.atlas.storage import load_atlas, save_atlas
from avatar_core.errors import AvatarError, StorageError


def test_a_future_schema_is_refused(atlas: Atlas, tmp_path: Path) -> None:
    save_atlas(atlas, tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as stored:
        stored.attrs["schema"] = "2.0"
    with pytest.raises(StorageError, match="upgrade avatar"):
        load_atlas(tmp_path / "a.h5")


@pytest.mark.parametrize("key", ["distances", "registered", "about", "faces"])
def test_one_bit_is_noticed(atlas: Atlas, tmp_path: Path, key: str) -> None:
    file = tmp_path / "a.h5"
    save_atlas(atlas, file)
    with h5py.File(file, "r") as stored:
        offset = stored[f"anatomies/000001/{key}"].id.get_offset()
    content = bytearray(file.read_bytes())
    content[offset + 8] ^= 1
    file.write_bytes(content)
    with pytest.raises(StorageError, match="checksum"):
        load_atlas(file)


def test_other_files_are_refused(atlas: Atlas, tmp_path: Path) -> None:
    file = tmp_path / "a.h5"
    with pytest.raises(StorageError, match="avatar atlas create"):
        load_atlas(file)
    save_atlas(atlas, file)
    file.write_bytes(file.read_bytes()[:-5000])
    with pytest.raises(StorageError, match="truncated"):
        load_atlas(file)
    with h5py.File(file, "w") as stored:
        stored.attrs["format"] = "avatar vademecum"
    with pytest.raises(StorageError, match="HDF5 but no atlas"):
        load_atlas(file)
    with pytest.raises(StorageError, match="folder"):
        save_atlas(atlas, tmp_path / "nowhere" / "a.h5")


@pytest.mark.parametrize(
    ("key", "spoil"),
    [
        ("anatomies/000001/distances", lambda a: a[:-1]),
        ("anatomies/000001/distances", lambda a: a * np.nan),
        ("anatomies/000001/faces", lambda a: a + 10**6),
        ("template/tets", lambda a: a + 10**6),
        ("template/clamped", lambda a: a[:-1]),
        ("gram/products", lambda a: a[:-1]),
    ],
)
def test_arrays_that_do_not_fit_are_refused(
    atlas: Atlas,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    key: str,
    spoil: Callable[[np.ndarray], np.ndarray],
) -> None:
    from avatar_core.common import hdf5

    encoded = hdf5.encoded

    def spoiled(arrays: dict[str, np.ndarray], *others: Any) -> memoryview:
        return encoded({**arrays, key: spoil(arrays[key])}, *others)

    monkeypatch.setattr(hdf5, "encoded", spoiled)  # with a checksum that is right
    save_atlas(atlas, tmp_path / "a.h5")
    with pytest.raises(AvatarError, match=r"again|atlas|surface"):
        load_atlas(tmp_path / "a.h5")
