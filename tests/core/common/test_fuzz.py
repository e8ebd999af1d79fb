"""Mutated files at the doors of the core: each is refused in one line or loaded, in any case."""

from __future__ import annotations

import pytest

from tests.helpers.fuzzing import campaign

QUICK = range(300)  # a third for each door
LONG = range(10_000, 10_300)


@pytest.mark.long
def test_a_mutant_is_refused_or_loaded() -> None:
    found = campaign("every", QUICK)
    assert not found.failures()
    assert min(found.counts[outcome] for outcome in ("refused", "loaded")) >= 30


@pytest.mark.long
@pytest.mark.parametrize("door", ["vademecum", "atlas", "surface", "step"])
def test_hundreds_of_mutants_are_refused_or_loaded(door: str) -> None:
    """And a vademecum that loads can be touched."""
    assert not campaign(door, LONG).failures()
