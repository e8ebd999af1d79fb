"""Mutated files given to the nodes: loader and patients' service."""

from __future__ import annotations

import pytest

from tests.helpers.fuzzing import campaign


@pytest.mark.long
@pytest.mark.parametrize("door", ["loader", "patient"])
def test_a_mutant_is_refused_or_loaded(door: str) -> None:
    found = campaign(door, range(100))
    assert not found.failures()
    assert min(found.counts[outcome] for outcome in ("refused", "loaded")) >= 10


@pytest.mark.long
@pytest.mark.parametrize("door", ["loader", "patient"])
def test_hundreds_of_mutants_are_refused_or_loaded(door: str) -> None:
    assert not campaign(door, range(20_000, 20_400)).failures()
