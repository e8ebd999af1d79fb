"""The progress bar of commands that build an organ."""

from __future__ import annotations

import math
import sys
from typing import ClassVar


class BuildBar:
    """A progress bar over the stages of a build, ``contact_sites`` among them or none."""

    _LINEAR: ClassVar = {"mesh": 0.1, "solve": 0.45, "modes": 0.2, "certify": 0.15, "time": 0.1}
    _PER_SITE: ClassVar = 0.4  # of a place, over all else
    _LARGE: ClassVar = {
        "mesh": 0.02,
        "solve": 0.05,
        "modes": 0.05,
        "certify": 0.03,
        "large": 0.3,
        "push": 0.5,
        "time": 0.05,
    }

    def __init__(self, large: bool = False, contact_sites: int = 0) -> None:
        total = 1.0 + self._PER_SITE * contact_sites
        stages = self._LARGE if large else self._LINEAR
        *first, last = ((name, length / total) for name, length in stages.items())
        self._stages = dict([*first, ("contacts", 1.0 - 1.0 / total), last])

    @classmethod
    def of(cls, stage: str) -> BuildBar:
        """A bar of one stage."""
        bar = cls()
        bar._stages = {stage: 1.0}
        return bar

    def __enter__(self) -> BuildBar:
        from tqdm import tqdm

        self._bar = tqdm(
            total=1.0,
            bar_format="{desc:22s} {percentage:3.0f}% |{bar}| {elapsed}",
            file=sys.stderr,
            disable=None,
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def __call__(self, stage: str, fraction: float, error: float) -> None:
        """Show the completed fraction of a stage, and the error (NaN: unknown)."""
        before = 0.0
        for name, length in self._stages.items():
            if name == stage:
                break
            before += length
        length = self._stages.get(stage, 0.0)
        text = stage if math.isnan(error) else f"{stage}, error {error:.1%}"
        self._bar.set_description_str(text, refresh=False)
        self._bar.n = min(1.0, before + length * min(fraction, 1.0))
        self._bar.refresh()
