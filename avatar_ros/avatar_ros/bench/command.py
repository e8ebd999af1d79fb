"""What every ``python -m avatar_ros.bench`` does around its measurement."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from avatar_core.errors import AvatarError


class Report(Protocol):
    """What a benchmark found."""

    def table(self) -> str:
        """In lines for a terminal."""

    def save(self, path: Path) -> None:
        """Write all figures as JSON."""


def print_report(measure: Callable[[], Report], output: Path | None = None) -> int:
    """Measure, save and print; returns the exit code."""
    try:
        report = measure()
    except AvatarError as error:
        print(f"avatar: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130  # by Ctrl-C, as shells count it
    if output:
        report.save(output)
    print(report.table(), flush=True)
    return 0
