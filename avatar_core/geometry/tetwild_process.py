"""fTetWild in its own process, with a fixed seed: run as a script by `tetwild.fill_box`.

fTetWild seeds its generators from `std::random_device` and keeps them from call to call, so that
two meshes of one surface differ. It takes no seed. This module replaces the import of
`std::random_device` in the library as loaded into this process, which ends with the mesh. The same
surface then gives the same mesh, bit for bit, with any number of threads.

The module imports numpy alone, since it is started anew for each mesh.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import signal
import sys
from importlib.util import module_from_spec, spec_from_file_location
from types import ModuleType
from typing import Any

import numpy as np

_NAME = "PyfTetWildWrapper"
_RANDOM = b"_ZNSt13random_device9_M_getvalEv"  # std::random_device::_M_getval()
_SEED = 5489  # the default seed of std::mt19937
_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of prctl(2)

# ELF-64, little endian (System V gABI, chapters 4 and 5).
_RELOCATIONS = 4  # SHT_RELA
_HEADER = np.dtype(
    {"names": ["sections", "count"], "formats": ["<u8", "<u2"], "offsets": [40, 60], "itemsize": 64}
)
_SECTION = np.dtype([("name", "<u4"), ("type", "<u4"), ("flags", "<u8"), ("address", "<u8"),
                     ("offset", "<u8"), ("size", "<u8"), ("link", "<u4"), ("info", "<u4"),
                     ("align", "<u8"), ("entry", "<u8")])  # fmt: skip
_SYMBOL = np.dtype([("name", "<u4"), ("kind", "<u4"), ("value", "<u8"), ("size", "<u8")])
_RELOCATION = np.dtype([("where", "<u8"), ("kind", "<u4"), ("symbol", "<u4"), ("addend", "<i8")])


def main() -> None:
    """Fill the box of the arrays in ``input.npz`` and write ``output.npz``, in this folder."""
    library, parent = sys.argv[1], int(sys.argv[2])
    if sys.platform.startswith("linux"):  # nobody waits for the mesh of a command that was killed
        ctypes.CDLL(None).prctl(_PARENT_DEATH_SIGNAL, signal.SIGKILL)
        if os.getppid() != parent:  # before it asked for the signal
            return
    module = _loaded(library)
    function = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_void_p)(lambda _: _SEED)
    seeded = _replace_import(library, _RANDOM, function)
    with np.load("input.npz") as file:
        arguments: list[Any] = [file[name] for name in file.files]
    arguments = [value.item() if value.ndim == 0 else value for value in arguments]
    vertices, tets = module.tetrahedralize_mesh(*arguments)[:2]  # it takes no names
    np.savez("output.npz", vertices=vertices, tets=tets, seeded=seeded)


def _loaded(library: str) -> ModuleType:
    spec = spec_from_file_location(_NAME, library)
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _replace_import(library: str, symbol: bytes, function: Any) -> bool:
    """Let a loaded library call ``function`` for ``symbol``; return whether it imports it."""
    if not sys.platform.startswith("linux"):
        return False
    places = [_base(library) + where for where in _imports(np.fromfile(library, np.uint8), symbol)]
    address = ctypes.cast(function, ctypes.c_void_p)
    for place in places:
        _make_writable(place)
        ctypes.memmove(place, ctypes.byref(address), ctypes.sizeof(address))
    return bool(places)


def _imports(file: np.ndarray, symbol: bytes) -> list[int]:
    """Return offsets, from where the library is loaded, of the pointers to an imported function."""

    def table(section: np.void, dtype: np.dtype[Any]) -> np.ndarray:
        count = int(section["size"]) // dtype.itemsize
        return np.frombuffer(file, dtype, count, int(section["offset"]))

    if file[:6].tobytes() != b"\x7fELF\2\1":
        return []
    header = np.frombuffer(file, _HEADER, 1)[0]
    sections = np.frombuffer(file, _SECTION, int(header["count"]), int(header["sections"]))
    found: list[int] = []
    for section in sections[sections["type"] == _RELOCATIONS]:
        symbols = sections[section["link"]]
        names = table(sections[symbols["link"]], np.dtype("u1")).tobytes()
        named = table(symbols, _SYMBOL)["name"]
        wanted = [k for k, name in enumerate(named) if names.startswith(symbol + b"\0", int(name))]
        relocations = table(section, _RELOCATION)
        found += relocations["where"][np.isin(relocations["symbol"], wanted)].tolist()
    return found


def _base(library: str) -> int:
    """Return the address that a library is loaded at."""
    path = os.path.realpath(library)
    with open("/proc/self/maps") as maps:
        return next(int(line.split("-")[0], 16) for line in maps if line.rstrip().endswith(path))


def _make_writable(place: int) -> None:
    """Lift the protection of the page of a pointer, set after the library was linked."""
    mprotect = ctypes.CDLL(None, use_errno=True).mprotect
    mprotect.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    page = place - place % mmap.PAGESIZE
    if mprotect(page, mmap.PAGESIZE, mmap.PROT_READ | mmap.PROT_WRITE):
        raise OSError(ctypes.get_errno(), "cannot make a page writable")


if __name__ == "__main__":
    main()
