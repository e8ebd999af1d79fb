"""The same file gives the same vademecum, in any process and with any number of threads."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from avatar_core.common.processes import ModuleProcess
from avatar_core.vademecum.storage import load_vademecum


@pytest.mark.long
def test_the_same_surface_gives_the_same_vademecum(livers_dir: Path, tmp_path: Path) -> None:
    """On one thread and on two, each in a process of its own: bit for bit but for times."""
    built = [tmp_path / f"{n}.h5" for n in (1, 2)]
    processes = [
        ModuleProcess(
            "avatar_core.cli.main",
            *("vademecum", str(livers_dir / "LiTS-4.obj"), "-o", str(path)),
            *("--vertices", "600", "--certify", "10"),
            n_threads=n,
            environment={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        for n, path in enumerate(built, start=1)
    ]
    assert [process.wait() for process in processes] == [0, 0]
    one, other = map(load_vademecum, built)
    assert one.id == other.id
    assert one.certificate is not None
    assert other.certificate is not None
    assert one.certificate.l2_mean == other.certificate.l2_mean
