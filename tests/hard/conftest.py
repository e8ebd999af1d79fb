"""Hard cases: each asserts physics, and reports a figure that the run ends with in a table."""

from __future__ import annotations

from collections.abc import Callable

import pytest

_FIGURES = pytest.StashKey[list[tuple[str, str]]]()


@pytest.fixture
def figure(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Reports what a case came to, beside its name."""
    figures = request.config.stash.setdefault(_FIGURES, [])
    name = f"{request.path.stem.removeprefix('test_')}: {request.node.name.removeprefix('test_')}"

    def report(value: str) -> None:
        figures.append((name, value))

    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    figures = sorted(set(terminalreporter.config.stash.get(_FIGURES, [])))
    if not figures:
        return
    terminalreporter.section("hard cases")
    width = max(len(name) for name, _ in figures)
    for name, value in figures:
        terminalreporter.line(f"{name:<{width}}  {value}")
