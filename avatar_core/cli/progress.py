"""Progress bars, on standard error where it is a terminal."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from avatar_core.offline.rule import Progress

_FROM = 2.0  # time after which the bar of a possibly short task is shown [s]

# Fractions of a build by stage; the fraction of "contacts" is added.
_LINEAR = {"mesh": 0.1, "solve": 0.45, "modes": 0.2, "certify": 0.15, "time": 0.1}
_LARGE = {
    "mesh": 0.02,
    "solve": 0.05,
    "modes": 0.05,
    "certify": 0.03,
    "large": 0.3,
    "push": 0.5,
    "time": 0.05,
}
_PER_SITE = 0.4  # time of a place of contacts, over all else


@contextmanager
def progress_bar(unit: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar after ``_FROM`` seconds; yield a function of the numbers of done and all items."""
    with _bar(unit=f" {unit}", delay=_FROM, leave=False) as bar:

        def show(done: int, total: int) -> None:
            bar.total = max(total, done)
            bar.update(done - bar.n)

        yield show


@contextmanager
def stage_bar(stages: dict[str, float] | None = None) -> Iterator[Progress]:
    """Show a bar of stages; yield a function of stage, fraction, and error (NaN: unknown).

    stages : fraction of each stage of the whole, in their order; None: fractions are of the whole
    """
    with _bar(total=1.0, bar_format="{desc:36s} {percentage:3.0f}% |{bar}| {elapsed}") as bar:

        def show(stage: str, fraction: float, error: float) -> None:
            text = stage if math.isnan(error) else f"{stage}, error {error:.1%}"
            bar.set_description_str(text, refresh=False)
            bar.n = min(1.0, fraction if stages is None else _reached(stages, stage, fraction))
            bar.refresh()

        yield show


def build_stages(large: bool = False, contact_sites: int = 0) -> dict[str, float]:
    """Return the stages of a build, with or without ``contact_sites``."""
    total = 1.0 + _PER_SITE * contact_sites
    *first, last = ((name, part / total) for name, part in (_LARGE if large else _LINEAR).items())
    return dict([*first, ("contacts", 1.0 - 1.0 / total), last])


def _reached(stages: dict[str, float], stage: str, fraction: float) -> float:
    names = list(stages)
    before = names[: names.index(stage)] if stage in stages else names
    return sum(stages[name] for name in before) + stages.get(stage, 0.0) * min(fraction, 1.0)


@contextmanager
def item_bar(total: int) -> Iterator[Callable[[int, int, str], None]]:
    """Show a bar of items; yield a function of the number done, an item's number and its name."""
    layout = "{desc:16.16s} {n_fmt}/{total_fmt} |{bar}| {elapsed}<{remaining}"
    with _bar(total=total, bar_format=layout) as bar:

        def show(done: int, _: int, name: str) -> None:
            bar.set_description_str(name, refresh=False)
            bar.update(done - bar.n)

        yield show


@contextmanager
def waiting(text: str) -> Iterator[None]:
    """Print a line, on a terminal with a count of the seconds."""
    if not sys.stderr.isatty():
        print(f"{text} ...", file=sys.stderr, flush=True)
        yield
        return
    done, start = threading.Event(), time.monotonic()

    def count() -> None:
        while not done.is_set():
            seconds = time.monotonic() - start
            print(f"\r{text} ... {seconds:3.0f} s", end="", file=sys.stderr, flush=True)
            done.wait(0.5)

    clock = threading.Thread(target=count, daemon=True)
    clock.start()
    try:
        yield
    finally:
        done.set()
        clock.join()
        print("\r\033[K", end="", file=sys.stderr, flush=True)


def _bar(**options: Any) -> Any:
    from tqdm import tqdm

    return tqdm(file=sys.stderr, disable=None, **options)
