"""Report of the slowest test files at the end of a run."""

from __future__ import annotations

from collections import Counter

import pytest

SHOWN, LEAST = 15, 5.0  # number of files, and time below which none is shown [s]


class SlowestFiles:
    """Sums of set-up, call and tear-down over all tests of a file, on any worker."""

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
