"""Number of examples that property tests draw: few in the quick suite, all with ``-m long``.

Every run draws the same examples; ``--hypothesis-profile=default`` looks for new ones.
"""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import Phase, settings

FEW, ALL = "few", "all"
_PART = 8  # the quick suite draws one example in this many

settings.register_profile(FEW, deadline=None, derandomize=True, print_blob=True, max_examples=12)
settings.register_profile(ALL, deadline=None, derandomize=True, print_blob=True)


def choose(config: pytest.Config) -> None:
    """Load the hypothesis profile of this run."""
    chosen = config.getoption("--hypothesis-profile", None)
    settings.load_profile(chosen or (ALL if _is_long(config) else FEW))


def examples(n: int, least: int = 1, **more: Any) -> settings:
    """Return settings for ``n`` examples; the quick suite draws only the first of them.

    least : smallest number drawn there; 0 runs only the examples written out in the test
    """
    few = settings.get_current_profile_name() == FEW
    if few and not least:
        return settings(phases=[Phase.explicit], **more)
    return settings(max_examples=min(n, max(least, n // _PART)) if few else n, **more)


def mark(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark tests that draw examples as long when the long tests run."""
    for item in items if _is_long(config) else []:
        drawn = getattr(getattr(item, "obj", None), "is_hypothesis_test", False)
        if drawn or item.get_closest_marker("examples"):
            item.add_marker("long")


def _is_long(config: pytest.Config) -> bool:
    return str(config.getoption("markexpr")).strip() == "long"
