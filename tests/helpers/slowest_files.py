"""Ends a run with its slowest files, so that growth is seen before it hurts."""

from __future__ import annotations

from collections import Counter

import pytest

SHOWN, LEAST = 15, 5.0  # files, and those below so many seconds not


class SlowestFiles:
    """Adds up set-up, call and tear-down of all tests of a file, on whichever worker."""

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        seconds = Counter[str]()
        for reports in terminalreporter.stats.values():
            for report in reports:
                if isinstance(report, pytest.TestReport):
                    seconds[report.nodeid.partition("::")[0]] += report.duration
        slowest = [(file, spent) for file, spent in seconds.most_common(SHOWN) if spent >= LEAST]
        if slowest:
            total = sum(seconds.values())
            terminalreporter.section(f"slowest of {len(seconds)} files, {total:.0f} s in all")
        for file, spent in slowest:
            terminalreporter.line(f"{spent:7.1f} s  {file}")
