"""Tetrahedra fill the whole organ."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib.machinery import EXTENSION_SUFFIXES, PathFinder
from inspect import unwrap
from pathlib import Path

import numpy as np
import pytest

from avatar_core.errors import MeshError
from avatar_core.geometry import mesh, tetwild
from avatar_core.geometry.mesh import tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.vademecum.model import Vademecum
from tests.helpers.mesh_mutations import encode, pristine
from tests.helpers.slowness import Deadline


@pytest.mark.long
def test_a_real_liver_keeps_its_lobes(real_vademecum: Vademecum, livers_dir: Path) -> None:
    """fTetWild's own filter dropped up to a third of Amos-007, in one run of four."""
    surface = read_surface(livers_dir / f"{real_vademecum.name}.obj")
    assert real_vademecum.mesh.volume == pytest.approx(surface.volume, rel=0.02)


def test_a_mesh_holds_the_volume_of_its_surface() -> None:
    """Facets cut the corners of a round surface: without a shift they lack 0.8 %."""
    surface = phantom_liver(12e-3)
    assert tetrahedralize(surface, 600).volume == pytest.approx(surface.volume, rel=3e-3)


@pytest.mark.long
def test_a_mesh_that_lacks_a_part_of_the_organ_is_refused() -> None:
    organ = phantom_liver(12e-3)
    apart = organ.vertices + np.array([0.5, 0.0, 0.0])
    both = SurfaceMesh(
        np.vstack([organ.vertices, apart]), np.vstack([organ.faces, organ.faces + len(apart)])
    )
    with pytest.raises(MeshError, match="49% of the volume"):
        tetrahedralize(both, 1000)


def test_the_same_surface_gives_the_same_mesh() -> None:
    """Without a seed, fTetWild inserts the faces in another order each time."""
    liver = phantom_liver(12e-3)
    one, other = (unwrap(mesh._fill)(liver, 0.03) for _ in range(2))
    np.testing.assert_array_equal(one.tets, other.tets)
    np.testing.assert_array_equal(one.vertices, other.vertices)


def test_a_system_where_the_seed_stays_random_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """If the compiled module is no ELF file, the mesh is made, with a notice that it is random."""
    monkeypatch.setattr(tetwild, "_PROCESS", tetwild._PROCESS.replace("ELF", "EXE"))
    with pytest.warns(RuntimeWarning, match="two meshes of one surface differ"):
        _filled()


_IMPORTS = """
import sys
import avatar_core
from avatar_core.geometry.mesh import tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
mesh = tetrahedralize(phantom_liver(12e-3), 600)
assert 400 < len(mesh.vertices) < 800
avatar_core.read_surface(sys.argv[1])
print(*{name.partition(".")[0] for name in sys.modules})
"""


def test_neither_pyvista_nor_vtk_is_imported(tmp_path: Path) -> None:
    """They are 580 MB, and are not installed with the project."""
    ball = tmp_path / "ball.vtk"
    ball.write_bytes(encode(pristine(), "vtk-polydata"))
    run = subprocess.run(
        [sys.executable, "-c", _IMPORTS, str(ball)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert run.returncode == 0, run.stderr
    imported = set(run.stdout.split())
    assert "avatar_core" in imported
    assert imported.isdisjoint({"pytetwild", "pyvista", "vtk", "vtkmodules"})


@pytest.fixture
def anew() -> Iterator[None]:
    """Find the compiled module again, before and after."""
    tetwild._compiled.cache_clear()
    yield
    tetwild._compiled.cache_clear()


def _filled() -> None:
    liver = phantom_liver(12e-3)
    tetwild.fill_box(liver.vertices, liver.faces, edge=0.1, envelope=4e-3)


@pytest.mark.usefixtures("anew")
def test_a_wheel_that_is_missing_or_has_no_module(monkeypatch: pytest.MonkeyPatch) -> None:
    for finder in (tetwild, PathFinder):
        with monkeypatch.context() as patch:
            patch.setattr(finder, "find_spec", lambda *_: None)
            with pytest.raises(MeshError, match=r"not installed; pip install 'pytetwild"):
                _filled()


@pytest.mark.usefixtures("anew")
def test_a_wheel_for_another_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "pytetwild"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / f"PyfTetWildWrapper{EXTENSION_SUFFIXES[0]}").write_bytes(b"for another system")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MeshError, match=r"does not fit this Python .*; pip install 'pytetwild"):
        _filled()


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="no /proc")
def test_a_command_that_is_killed_takes_the_process_with_it() -> None:
    parent = subprocess.Popen(
        [sys.executable, "-c", _IMPORTS.replace("12e-3), 600", "6e-3), 300000")],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
    passed = Deadline(60.0)
    while not (started := children.read_text().split()):
        assert not passed
        assert parent.poll() is None
        time.sleep(0.01)
    filling = Path(f"/proc/{started[0]}/stat")
    passed = Deadline(20.0)
    while b"fTetWild" not in filling.with_name("cmdline").read_bytes():
        assert not passed
    parent.kill()  # before the process asked to end with its parent, or after
    parent.wait()
    passed = Deadline(5.0)
    try:
        while filling.exists() and filling.read_text().rpartition(")")[2].split()[0] != "Z":
            assert not passed
            time.sleep(0.01)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(started[0]), signal.SIGKILL)


ANOTHER = "another interface .*; pip install 'pytetwild"


@pytest.mark.parametrize(
    ("module", "said"),
    [
        ("", ANOTHER),
        ("def tetrahedralize_mesh(vertices, faces):\n    return None\n", ANOTHER),
        ("import os\nos.abort()\n", r"crashed on this surface \(signal 6\); repair the surface"),
        ("raise RuntimeError('no inside')\n", r"found no mesh \(RuntimeError: no inside\); repair"),
    ],
)
def test_what_the_compiled_module_does_wrong_is_told_in_one_line(
    module: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "PyfTetWildWrapper.py"
    file.write_text(module)
    monkeypatch.setattr(tetwild, "_compiled", lambda: str(file))
    with pytest.raises(MeshError, match=said):
        _filled()
