"""Runs mutants in processes that may die of them, and says what became of each."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

CHILD = Path(__file__).with_name("fuzz_child.py")
OUTCOMES = ("loaded", "refused")


@dataclass(frozen=True)
class Campaign:
    """door : of fuzz_child.py; results : by seed, what it says of each mutant."""

    door: str
    results: dict[int, dict[str, Any]]

    @property
    def counts(self) -> Counter[str]:
        """Mutants by outcome."""
        return Counter(result["outcome"] for result in self.results.values())

    def failures(self) -> list[str]:
        """What is neither loaded nor refused as it should be, with the command that repeats it."""
        return [
            f"{result['outcome']} ({result['message'][:100]}): python tests/hard/{CHILD.name} "
            f"{self.door} {seed} {seed + 1} FOLDER"
            for seed, result in self.results.items()
            if result["outcome"] not in OUTCOMES
        ]

    def figures(self) -> str:
        """One line."""
        slowest = max(self.results.values(), key=lambda result: result["seconds"])
        peak = max(result["peak"] for result in self.results.values())
        counts = self.counts
        return (
            f"{len(self.results)} mutants: {counts['refused']} refused, {counts['loaded']} loaded, "
            f"slowest {slowest['seconds']:.2f} s, peak {peak / 1e6:.0f} MB"
        )


def campaign(door: str, seeds: range) -> Campaign:
    """Open all mutants at a door; a process that dies is a result, and another one goes on."""
    results: dict[int, dict[str, Any]] = {}
    while len(results) < len(seeds):
        first = seeds.start + len(results)
        child = subprocess.run(
            [sys.executable, str(CHILD), door, str(first), str(seeds.stop)],
            capture_output=True,
            text=True,
        )
        for line in child.stdout.splitlines():
            result = _result(line, f"ended with {child.returncode}: {child.stderr[-300:]}")
            results[result["seed"]] = result
        if seeds.start + len(results) == first:
            raise AssertionError(
                f"{CHILD.name} {door} {first} did not start: {child.stderr[-500:]}"
            )
    return Campaign(door, results)


def _result(line: str, end: str) -> dict[str, Any]:
    try:
        return dict(json.loads(line))
    except ValueError:  # the last one, that the process died of
        seed = int(line.split(":")[1].split(",")[0])
        return {"seed": seed, "outcome": "died", "message": end, "seconds": 0.0, "peak": 0}
