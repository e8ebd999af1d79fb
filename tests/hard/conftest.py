"""Hard cases: each asserts physics, and reports a figure that the run ends with in a table."""

from __future__ import annotations

from collections.abc import Callable

import pytest

_FIGURE = "figure"  # property of a test's report: those cross from a worker's process


@pytest.fixture
def figure(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Reports what a case came to, beside its name."""
    name = f"{request.path.stem.removeprefix('test_')}: {request.node.name.removeprefix('test_')}"

    def report(value: str) -> None:
        request.node.user_properties.append((_FIGURE, (name, value)))

    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reports = [r for key in ("passed", "failed") for r in terminalreporter.getreports(key)]
    figures = sorted(
        {tuple(value) for r in reports for key, value in r.user_properties if key == _FIGURE}
    )
    if not figures:
        return
    terminalreporter.section("hard cases")
    width = max(len(name) for name, _ in figures)
    for name, value in figures:
        terminalreporter.line(f"{name:<{width}}  {value}")
