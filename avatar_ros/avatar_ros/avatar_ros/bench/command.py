"""Report and exit code that every ``python -m avatar_ros.bench`` shares."""

from __future__ import annotations

import json
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar

from avatar_core.common.dataclass_json import plain
from avatar_core.errors import AvatarError


@dataclass(frozen=True)
class Report(ABC):
    """Base of the benchmarks' reports; ``name`` is that of the benchmark."""

    name: ClassVar[str]

    @property
    @abstractmethod
    def summary(self) -> dict[str, float]:
        """Return the key figures."""

    @abstractmethod
    def table(self) -> str:
        """Return the report as lines for a terminal."""

    def figures(self) -> dict[str, Any]:
        """Return all figures by name."""
        return asdict(self)

    def save(self, path: Path) -> None:
        """Write all figures as JSON; figures that could not be measured are null."""
        document = {"name": self.name, "summary": self.summary, **self.figures()}
        path.write_text(json.dumps(plain(document), indent=2, allow_nan=False) + "\n")


def print_report(measure: Callable[[], Report], output: Path | None = None) -> int:
    """Measure, save and print; return the exit code."""
    try:
        report = measure()
    except AvatarError as error:
        print(f"avatar: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130  # exit code of shells after Ctrl-C
    if output:
        report.save(output)
    print(report.table(), flush=True)
    return 0
