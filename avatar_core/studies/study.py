"""Results of a study: what it prints and writes, with the paper's figures and the machine."""

from __future__ import annotations

import json
import math
import os
import platform
import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from avatar_core.common.machine import processor
from avatar_core.offline.rule import Progress

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Value = float | int | str | bool | None
Item = TypeVar("Item")

PACKAGES = ("avatar", "numpy", "scipy", "libigl", "scikit-fem", "rslab", "scikit-learn")


@dataclass(frozen=True, eq=False)
class Study:
    """Result of an experiment.

    name : of the files it is written to
    sentence : the finding, in one sentence, for the picture
    summary : key figures; errors are fractions, times seconds, lengths have their unit in the key
    rows : one mapping per measurement
    paper : values of the paper, under the same keys as in the summary
    draw : draws the picture
    notices : what was skipped or done differently from the request, one line each
    """

    name: str
    sentence: str
    summary: Mapping[str, float]
    rows: tuple[Mapping[str, Value], ...]
    paper: Mapping[str, Value]
    draw: Callable[[Figure], None]
    notices: tuple[str, ...] = ()

    def table(self) -> str:
        """The summary beside the values of the paper."""
        width = max(len(key) for key in self.summary)
        lines = [f"{'':{width}s} {'paper':>24s} {'here':>12s}"]
        for key, value in self.summary.items():
            lines.append(f"{key:{width}s} {_text(self.paper.get(key)):>24s} {_text(value):>12s}")
        return "\n".join(lines)


def write_study(study: Study, folder: Path, seconds: float) -> tuple[Path, Path]:
    """Write ``NAME.json`` and ``NAME.png``; the folder is made if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    document = {
        "name": study.name,
        "sentence": study.sentence,
        "summary": dict(study.summary),
        "rows": [dict(row) for row in study.rows],
        "paper": dict(study.paper),
        "notices": list(study.notices),
        "machine": machine(),
        "seconds": seconds,
    }
    record, picture = folder / f"{study.name}.json", folder / f"{study.name}.png"
    record.write_text(json.dumps(_plain(document), indent=2, allow_nan=False) + "\n")
    _draw(study, picture)
    return record, picture


def machine() -> dict[str, Value]:
    """Processor, cores, load and versions."""
    found: dict[str, Value] = {
        "processor": processor(),
        "cores": os.cpu_count(),
        "load_average": os.getloadavg()[0],
        "system": platform.platform(),
        "python": platform.python_version(),
    }
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    return found


class RowFile:
    """Rows of a study as they are measured, one JSON object a line in ``NAME.rows.jsonl``.

    A study that is interrupted after an hour leaves what it had found, and goes on from there.

    path : of the file, which is begun if it is not there
    key : by which rows are told apart
    """

    def __init__(self, path: Path, key: str) -> None:
        self._path = path
        lines = path.read_text().splitlines() if path.is_file() else []
        found = [row for row in map(_parsed, lines) if row is not None]
        self.rows: dict[str, dict[str, Value]] = {str(row[key]): row for row in found}
        path.write_text("".join(_line(row) for row in found))

    def add(self, row: Mapping[str, Value]) -> None:
        """Append a row."""
        with self._path.open("a") as file:
            file.write(_line(row))


def _line(row: Mapping[str, Value]) -> str:
    return json.dumps(_plain(dict(row)), allow_nan=False) + "\n"


def _parsed(line: str) -> dict[str, Value] | None:
    """A row; None for a line that was cut off."""
    try:
        row: dict[str, Value] = json.loads(line)
    except ValueError:
        return None
    return row


def follow(items: Iterable[Item], text: str) -> Iterator[Item]:
    """Iterate with a progress bar, which is shown on a terminal only."""
    from tqdm import tqdm

    yield from tqdm(items, desc=f"{text:28s}", file=sys.stderr, disable=None, leave=False)


class ProgressBar:
    """A progress bar over the long stages of a study; shows what the current one is doing."""

    def __init__(self, n_stages: int) -> None:
        self._n_stages, self._begun = n_stages, 0

    def __enter__(self) -> ProgressBar:
        from tqdm import tqdm

        self._bar = tqdm(total=self._n_stages, file=sys.stderr, disable=None, leave=False)
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def begin(self, name: str) -> Progress:
        """Begin a stage, which ends the one before; returns what its builds report to."""
        self._bar.update(1 if self._begun else 0)
        self._begun += 1
        self._bar.set_description_str(name)

        def progress(stage: str, fraction: float, error: float) -> None:
            known = "" if math.isnan(error) else f", error {error:.1%}"
            self._bar.set_description_str(f"{name}: {stage} {fraction:.0%}{known}")

        return progress


def mean_and_worst(key: str, values: Iterable[float]) -> dict[str, float]:
    """Mean under ``key`` and maximum under ``key_worst``; NaN if there are no values."""
    found = [float(value) for value in values]
    if not found:
        return {key: math.nan, f"{key}_worst": math.nan}
    return {key: sum(found) / len(found), f"{key}_worst": max(found)}


def _draw(study: Study, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(11.0, 4.8), layout="constrained")
    study.draw(figure)
    figure.suptitle(textwrap.fill(study.sentence, 130), fontsize=10)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _text(value: Value) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _plain(value: Any) -> Any:
    """Plain Python scalars; NaN, which JSON does not have, becomes null."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
