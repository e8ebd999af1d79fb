"""Mutated files at the core's loaders: each is refused in one line or loaded."""

from __future__ import annotations

import pytest

from tests.helpers.fuzzing import campaign

QUICK = range(300)  # a third for each loader
LONG = range(10_000, 10_300)


@pytest.mark.long
def test_a_mutant_is_refused_or_loaded() -> None:
    found = campaign("every", QUICK)
    assert not found.failures()
    assert min(found.counts[outcome] for outcome in ("refused", "loaded")) >= 30


@pytest.mark.long
@pytest.mark.parametrize("door", ["vademecum", "atlas", "surface", "step"])
def test_hundreds_of_mutants_are_refused_or_loaded(door: str) -> None:
    """A vademecum that loads can also be touched."""
    assert not campaign(door, LONG).failures()
