"""Compiled functions on disk: a change in any file they are made of gives another cache."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import avatar_core
from avatar_core.common import compiled_cache

PACKAGE = Path(avatar_core.__file__).resolve().parent

HELPER = """
from avatar_core.common.jit import inlined

@inlined
def term(x):
    return {factor} * x
"""
USER = """
from avatar_core.common.jit import entry
from avatar_core.contact.helper_of_test import term

@entry
def total(x):
    return term(x)

print(total(1.0), total.stats.cache_hits[(total.signatures[0])] if total.stats.cache_hits else 0)
"""


def run(package: Path, cache: Path, factor: float) -> list[str]:
    """Run a compiled function whose inlined part, in another file, has this factor."""
    contact = package / "avatar_core" / "contact"
    (contact / "helper_of_test.py").write_text(HELPER.format(factor=factor))
    (contact / "user_of_test.py").write_text(USER)
    environment = {**os.environ, "PYTHONPATH": str(package), "NUMBA_CACHE_DIR": str(cache)}
    environment["PYTHONDONTWRITEBYTECODE"] = "1"  # Python knows a file by its second and size
    command = [sys.executable, "-m", "avatar_core.contact.user_of_test"]
    found = subprocess.run(command, env=environment, cwd="/", capture_output=True, text=True)
    assert not found.returncode, found.stderr
    return found.stdout.split()


def test_a_change_in_an_inlined_file_is_compiled_anew(tmp_path: Path) -> None:
    package, cache = tmp_path / "package", tmp_path / "cache"
    ignored = shutil.ignore_patterns("__pycache__", "studies", "cli", "atlas", "offline", "scene")
    shutil.copytree(PACKAGE, package / "avatar_core", ignore=ignored)
    assert run(package, cache, 2.0) == ["2.0", "0"]
    assert run(package, cache, 2.0) == ["2.0", "1"]  # found in the cache
    assert run(package, cache, 3.0) == ["3.0", "0"]  # numba's own cache answers 2 here
    assert run(package, cache, 2.0) == ["2.0", "1"]  # the earlier result is kept


def test_a_part_is_found_on_disk(tmp_path: Path) -> None:
    """Another function, in another process, uses the compiled part that the first one left."""
    part = "from avatar_core.common.jit import inlined\n@inlined\ndef square(x): return x * x\n"
    uses = """
from avatar_core.common.jit import entry
from part import square

@entry
def total(x):
    return square(x) + {more}

print(total(3.0), sum(square.stats.cache_hits.values()))
"""
    (tmp_path / "part.py").write_text(part)
    paths = os.pathsep.join((str(tmp_path), str(PACKAGE.parent)))
    environment = {**os.environ, "PYTHONPATH": paths, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    for more, hits in ((1.0, "0"), (2.0, "1")):
        user = tmp_path / f"uses_{more}.py"
        user.write_text(uses.format(more=more))
        found = subprocess.run(
            [sys.executable, user], env=environment, capture_output=True, text=True
        )
        assert not found.returncode, found.stderr
        assert found.stdout.split() == [str(9.0 + more), hits]


def test_folders_of_other_contents_do_not_pile_up(tmp_path: Path) -> None:
    for i in range(12):
        old = tmp_path / "avatar" / f"{i:016d}"
        old.mkdir(parents=True)
        os.utime(old, (i, i))
    code = "from avatar_core.common.compiled_cache import folder; print(folder())"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    made = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    ).stdout.strip()
    left = {path.name for path in (tmp_path / "avatar").iterdir()}
    assert left == {Path(made).name} | {f"{i:016d}" for i in range(4, 12)}


def test_code_that_is_compiled_into_other_files_is_of_the_rooms_that_are_hashed() -> None:
    """Studies compile only for themselves, and their files add their own content."""
    package = Path(compiled_cache.__file__).parents[1]
    using = [p for p in package.rglob("*.py") if "avatar_core.common.jit import" in p.read_text()]
    assert {p.relative_to(package).parts[0] for p in using} <= {*compiled_cache.ROOMS, "studies"}
