"""The frame of all studies: :class:`Study`, one :class:`Run` of it, its rows and its files.

A study is a module of this package with an instance of :class:`Study`, ``STUDY``. The study
measures and sums up; folders, row files, tables, JSON and pictures are made here.
"""

from __future__ import annotations

import json
import math
import os
import platform
import sys
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from avatar_core.common.dataclass_json import plain
from avatar_core.common.machine import processor
from avatar_core.offline.rule import Progress

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Value = float | int | str | bool | None
Row = dict[str, Value]
Item = TypeVar("Item")
S = TypeVar("S")

_IN_ROW = 3  # panels of a picture
PACKAGES = ("avatar", "numpy", "scipy", "libigl", "scikit-fem", "rslab", "scikit-learn")


class Study(ABC, Generic[S]):
    """An experiment.

    name : name of the command and of the files it writes
    full, quick : its settings, and those of a smaller version that takes minutes
    paper : values of the paper, under the same keys as in the summary
    key : column that tells rows apart, by which an interrupted run goes on; empty: none does
    """

    name: str
    full: S
    quick: S
    paper: ClassVar[Mapping[str, Value]] = {}
    key = ""

    @abstractmethod
    def measure(self, run: Run[S]) -> None:
        """Add a row for each measurement."""

    @abstractmethod
    def summary(self, run: Run[S]) -> dict[str, float]:
        """Return key figures: errors are fractions, times seconds.

        Keys hold the unit of lengths.
        """

    @abstractmethod
    def sentence(self, run: Run[S]) -> str:
        """Return the finding, in one sentence, for the picture."""

    @abstractmethod
    def draw(self, figure: Figure, run: Run[S]) -> None:
        """Draw the picture."""

    def conduct(self, settings: S, folder: Path, surfaces: Path | None = None) -> Run[S]:
        """Measure and sum up.

        Parameters
        ----------
        settings : S
            Settings, e.g. ``full``.
        folder : Path
            Folder to write to; it is made if it does not exist.
        surfaces : Path or None
            Folder of liver surfaces [mm]; None for the default one.
        """
        folder.mkdir(parents=True, exist_ok=True)
        run = Run(self, settings, folder, surfaces)
        self.measure(run)
        run.summary = self.summary(run)
        return run


@dataclass(eq=False)
class Run(Generic[S]):
    """Inputs of a study and its findings.

    settings, folder, surfaces : as given to :meth:`Study.conduct`
    rows : one mapping per measurement
    notices : rows that were skipped or done differently from the request, one line each
    kept : further data for the summary or the picture
    summary : key figures
    """

    study: Study[S]
    settings: S
    folder: Path
    surfaces: Path | None = None
    rows: list[Row] = field(default_factory=list)
    notices: list[str] = field(default_factory=list)
    kept: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        path, key = self.folder / f"{self.study.name}.rows.jsonl", self.study.key
        self._file = RowFile(path, key) if key else None

    def add(self, row: Row) -> None:
        """Keep a row, also in the row file if the study can go on after an interruption."""
        self.rows.append(row)
        if self._file is not None:
            self._file.add(row)

    def is_known(self, name: str) -> bool:
        """Return whether an interrupted run has measured this row; its file then holds it."""
        row = self._file.rows.get(name) if self._file is not None else None
        if row is not None:
            self.rows.append(row)
        return row is not None

    @property
    def sentence(self) -> str:
        """The finding, in one sentence."""
        return self.study.sentence(self)

    def table(self) -> str:
        """Return the summary beside the values of the paper."""
        width = max(len(key) for key in self.summary)
        lines = [f"{'':{width}s} {'paper':>24s} {'here':>12s}"]
        for key, value in self.summary.items():
            paper = _text(self.study.paper.get(key))
            lines.append(f"{key:{width}s} {paper:>24s} {_text(value):>12s}")
        return "\n".join(lines)

    def write(self, seconds: float) -> tuple[Path, Path]:
        """Write ``NAME.json`` and ``NAME.png``, and return their paths."""
        document = {
            "name": self.study.name,
            "sentence": self.sentence,
            "summary": self.summary,
            "rows": self.rows,
            "paper": dict(self.study.paper),
            "notices": self.notices,
            "machine": machine(),
            "seconds": seconds,
        }
        record, picture = (self.folder / f"{self.study.name}.{end}" for end in ("json", "png"))
        record.write_text(json.dumps(plain(document), indent=2, allow_nan=False) + "\n")
        self._draw(picture)
        return record, picture

    def _draw(self, path: Path) -> None:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt

        figure = plt.figure(figsize=(11.0, 4.8), layout="constrained")
        self.study.draw(figure, self)
        figure.suptitle(textwrap.fill(self.sentence, 130), fontsize=10)
        figure.savefig(path, dpi=110)
        plt.close(figure)


def machine() -> dict[str, Value]:
    """Return the processor, cores, load and versions."""
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
    """Rows of a study, one JSON object a line in ``NAME.rows.jsonl``, written when measured.

    A study that is interrupted after an hour leaves its findings, and goes on from there.

    path : file, which is begun if it does not exist
    key : column by which rows are told apart
    """

    def __init__(self, path: Path, key: str) -> None:
        self._path = path
        lines = path.read_text().splitlines() if path.is_file() else []
        found = [row for row in map(_parsed, lines) if row is not None]
        self.rows: dict[str, Row] = {str(row[key]): row for row in found}
        path.write_text("".join(_line(row) for row in found))

    def add(self, row: Row) -> None:
        """Append a row."""
        with self._path.open("a") as file:
            file.write(_line(row))


def _line(row: Row) -> str:
    return json.dumps(plain(row), allow_nan=False) + "\n"


def _parsed(line: str) -> Row | None:
    """Return a row, with NaN for null; None for a line that was cut off."""
    try:
        row: Row = json.loads(line)
    except ValueError:
        return None
    return {key: math.nan if value is None else value for key, value in row.items()}


def where(rows: Iterable[Row], **wanted: Value) -> list[Row]:
    """Return the rows whose columns have these values, e.g. ``kind="map", delay=0``."""
    return [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]


def column(rows: Iterable[Row], key: str) -> NDArray[np.float64]:
    """Return the numbers of a column, in the rows that have it."""
    return np.array([row[key] for row in rows if key in row], float)


@dataclass(frozen=True)
class Panel:
    """One plot of several, and the sentence above it."""

    sentence: str
    draw: Callable[[Axes], None]


def draw_panels(figure: Figure, panels: Sequence[Panel]) -> None:
    """Draw panels in rows of three; the finding above them takes two inches."""
    n_rows = -(-len(panels) // _IN_ROW)
    figure.set_size_inches(5.0 * _IN_ROW, 2.0 + 4.5 * n_rows)
    for k, panel in enumerate(panels):
        axes = figure.add_subplot(n_rows, _IN_ROW, k + 1)
        panel.draw(axes)
        axes.set_title(textwrap.fill(panel.sentence, 70), fontsize=8)


def label(axes: Axes, x: str, y: str, title: str = "", legend: float = 8.0) -> None:
    """Name both axes, and add a grid and a legend of this font size (0: none)."""
    axes.set(xlabel=x, ylabel=y, title=title)
    axes.grid(which="both", alpha=0.3)
    if legend:
        axes.legend(fontsize=legend)


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
        """Begin a stage, which ends the one before; return the progress for its builds."""
        self._bar.update(1 if self._begun else 0)
        self._begun += 1
        self._bar.set_description_str(name)

        def progress(stage: str, fraction: float, error: float) -> None:
            known = "" if math.isnan(error) else f", error {error:.1%}"
            self._bar.set_description_str(f"{name}: {stage} {fraction:.0%}{known}")

        return progress


def mean_and_worst(key: str, values: Iterable[float]) -> dict[str, float]:
    """Return the mean under ``key`` and maximum under ``key_worst``; NaN if there are no values."""
    found = [float(value) for value in values]
    if not found:
        return {key: math.nan, f"{key}_worst": math.nan}
    return {key: sum(found) / len(found), f"{key}_worst": max(found)}


def _text(value: Value) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
