"""Python of the README and of the gallery, run as it stands on the page."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import matplotlib
import pytest

import avatar_core as av
from avatar_core import pipeline
from tests.helpers.disk_cache import cached_on_disk

_built = cached_on_disk(pipeline.build)


def code_of(page: Path) -> str:
    """Return the only Python block of a page."""
    (code,) = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    return str(code)


def run(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run the Python of a page as a script in a folder and return its names.

    A build is that of an earlier run of the same code on the same organ and options.
    """
    matplotlib.use("Agg")
    monkeypatch.setattr(av, "build", _built)
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(compile(code_of(page), str(page), "exec"), names)
    return names
