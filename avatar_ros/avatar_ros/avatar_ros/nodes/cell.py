"""A planning cell without the launch package: its nodes as processes that end together.

A node that dies is started again, at once and then after increasing waits. A node that refuses to
start, or was told to end, ends the cell.

Run as ``avatar cell``.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from functools import partial
from pathlib import Path

from avatar_core.common.processes import ModuleProcess
from avatar_ros.framework import realtime
from avatar_ros.framework.stop_signal import StopSignal

_POLL = 0.1  # [s]
_STOP_TIMEOUT = 5.0  # time for a node to end by itself [s]
# time after which an error no longer belongs to the start, such as a wrong parameter [s]
_STARTED = 10.0
_WELL = 60.0  # running time after which earlier deaths are forgotten [s]
_LONGEST_WAIT = 30.0  # longest wait before a node is started again [s]

# parameters that override those of the file, by node
OVERRIDES = {
    "vademecum_loader": ("library_dir", "vademecum", "state_dir"),
    "contact": ("tools", "scene", "state_dir"),
    "patient_interpolation": ("library_dir", "atlas"),
    "planning_ui": ("library_dir", "host", "port"),
}
# nodes that run only if this option was given
REQUIRED = {"patient_interpolation": "atlas", "planning_ui": "ui"}
LISTS = ("tools",)  # given as words separated by commas


def node_arguments(params: Path | None, given: dict[str, str]) -> dict[str, list[str]]:
    """Return the arguments of each node that runs, by name; some run only on request."""
    found = {}
    for node, names in OVERRIDES.items():
        if REQUIRED.get(node, node) not in {node, *given}:
            continue
        own = [f"{name}:={_value(name, given[name])}" for name in names if name in given]
        arguments = ["--params-file", str(params)] if params is not None else []
        arguments += [word for pair in own for word in ("-p", pair)]
        found[node] = ["--ros-args", *arguments] if arguments else []
    return found


def _value(name: str, given: str) -> str:
    """Write a value as ROS reads it."""
    return f"[{given}]" if name in LISTS else given


class KeptNode:
    """Process of a node, started again when it dies."""

    def __init__(self, name: str, words: list[str]) -> None:
        self.name, self._words = name, words
        self._deaths, self._again = 0, 0.0
        self._start()

    def _start(self) -> None:
        self._began, self._is_dead = time.monotonic(), False
        self.process = ModuleProcess(
            f"avatar_ros.nodes.{self.name}",
            *self._words,
            preexec_fn=partial(realtime.die_with_parent, signal.SIGINT),
        )

    def tend(self) -> bool:
        """Restart the node if it died, and report that; return False if the cell cannot go on."""
        code, now = self.process.poll(), time.monotonic()
        if code is None:
            return True
        if self._is_dead:
            if now >= self._again:
                self._start()
            return True
        lived = now - self._began
        if code == 0 or (code > 0 and lived < _STARTED):
            _say(f"{self.name} ended with code {code}; ending the cell")
            return False
        self._deaths = 1 if lived > _WELL else self._deaths + 1
        wait = wait_after(self._deaths)
        self._is_dead, self._again = True, now + wait
        how = f"died of {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"
        _say(f"{self.name} {how}; starting it again" + (f" in {wait:g} s" if wait else ""))
        return True


def wait_after(deaths: int) -> float:
    """Return the wait before a node is started again after this many deaths in a row [s]."""
    return 0.0 if deaths < 2 else min(2.0 ** (deaths - 2), _LONGEST_WAIT)


def run(arguments: dict[str, list[str]]) -> int:
    """Keep the nodes running until one cannot, or a signal comes; return the exit code."""
    stop = StopSignal()
    nodes = [KeptNode(name, words) for name, words in arguments.items()]
    goes_on = True
    while goes_on and not stop:
        time.sleep(_POLL)
        goes_on = all([node.tend() for node in nodes])
    codes = []
    for node in nodes:
        ended = node.process.poll() is not None
        code = node.process.finish(_STOP_TIMEOUT, signal.SIGINT)
        if not ended:
            codes.append(code)
        if code == -signal.SIGKILL and not ended:
            _say(f"{node.name} did not end in {_STOP_TIMEOUT:g} s and was killed")
    return 0 if goes_on and not any(codes) else 1


def _say(text: str) -> None:
    print(f"avatar: {text}", file=sys.stderr, flush=True)


def main() -> int:
    """Run the cell as the command line asks; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m avatar_ros.nodes.cell")
    parser.add_argument("--params", type=Path)
    for name in sorted({name for names in OVERRIDES.values() for name in names}):
        parser.add_argument(f"--{name}")
    parser.add_argument("--ui", action="store_const", const="yes")
    chosen = vars(parser.parse_args())
    params = chosen.pop("params")
    return run(node_arguments(params, {name: value for name, value in chosen.items() if value}))


if __name__ == "__main__":
    raise SystemExit(main())
