"""A planning cell without the launch package: its nodes as processes that end together.

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
from avatar_ros.framework.managed_node import StopSignal

_POLL = 0.1  # [s]
_STOP_TIMEOUT = 5.0  # for a node to end by itself [s]

# Parameters that override those of the file, by node.
OVERRIDES = {
    "vademecum_loader": ("library_dir", "vademecum", "state_dir"),
    "contact": ("scene", "state_dir"),
    "patient_interpolation": ("library_dir", "atlas"),
    "planning_ui": ("library_dir", "host", "port"),
}
# Nodes that run only if this was given.
REQUIRED = {"patient_interpolation": "atlas", "planning_ui": "ui"}


def node_arguments(params: Path | None, given: dict[str, str]) -> dict[str, list[str]]:
    """The arguments of each node that runs, by name; some run only if they are asked for."""
    found = {}
    for node, names in OVERRIDES.items():
        if REQUIRED.get(node, node) not in {node, *given}:
            continue
        own = [f"{name}:={given[name]}" for name in names if name in given]
        arguments = ["--params-file", str(params)] if params is not None else []
        arguments += [word for pair in own for word in ("-p", pair)]
        found[node] = ["--ros-args", *arguments] if arguments else []
    return found


def run(arguments: dict[str, list[str]]) -> int:
    """Keep the nodes running until one ends or a signal comes; returns the exit code."""
    stop = StopSignal()
    processes = {
        name: ModuleProcess(
            f"avatar_ros.nodes.{name}",
            *words,
            preexec_fn=partial(realtime.die_with_parent, signal.SIGINT),
        )
        for name, words in arguments.items()
    }
    ended: dict[str, int] = {}
    while not stop and not ended:
        time.sleep(_POLL)
        polled = {name: process.poll() for name, process in processes.items()}
        ended = {name: code for name, code in polled.items() if code is not None}
    for name, code in ended.items():
        print(f"avatar: {name} ended with code {code}; ending the cell", file=sys.stderr)
    codes = []
    for name, process in processes.items():
        code = process.finish(_STOP_TIMEOUT, signal.SIGINT)
        codes.append(code)
        if code == -signal.SIGKILL and name not in ended:
            print(
                f"avatar: {name} did not end in {_STOP_TIMEOUT:g} s and was killed", file=sys.stderr
            )
    return 0 if not ended and not any(codes) else 1


def main() -> int:
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
