"""A planning cell without the launch package: its nodes as processes that end together.

Run as ``avatar cell``.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

from avatar_ros.framework import realtime
from avatar_ros.framework.managed_node import StopSignal

_POLL = 0.1  # [s]
_STOP_TIMEOUT = 5.0  # for a node to end by itself [s]

# What goes before the file of parameters, by node.
TAKES = {
    "vademecum_loader": ("library_dir", "vademecum", "state_dir"),
    "contact": ("scene", "state_dir"),
    "patient_interpolation": ("library_dir", "atlas"),
    "planning_ui": ("library_dir", "host", "port"),
}
# Nodes that run only where this was given.
ASKED_FOR = {"patient_interpolation": "atlas", "planning_ui": "ui"}


def commands(params: Path | None, given: dict[str, str]) -> dict[str, list[str]]:
    """Of each node that runs, by name; some only if they are asked for."""
    found = {}
    for node, names in TAKES.items():
        if ASKED_FOR.get(node, node) not in {node, *given}:
            continue
        own = [f"{name}:={given[name]}" for name in names if name in given]
        arguments = ["--params-file", str(params)] if params is not None else []
        arguments += [word for pair in own for word in ("-p", pair)]
        command = [sys.executable, "-m", f"avatar_ros.nodes.{node}"]
        found[node] = [*command, "--ros-args", *arguments] if arguments else command
    return found


def run(commands: dict[str, list[str]]) -> int:
    """Keep the nodes running until one ends or a signal comes; the exit code."""
    stop = StopSignal()
    environment = realtime.single_threaded_libraries(dict(os.environ))
    processes = {
        name: subprocess.Popen(
            command,
            cwd="/",  # -m would let a checkout there stand before what is installed
            env=environment,
            start_new_session=True,  # Ctrl-C is for the cell, which ends them in order
            preexec_fn=partial(realtime.die_with_parent, signal.SIGINT),
        )
        for name, command in commands.items()
    }
    ended: dict[str, int] = {}
    while not stop and not ended:
        time.sleep(_POLL)
        codes = {name: process.poll() for name, process in processes.items()}
        ended = {name: code for name, code in codes.items() if code is not None}
    for name, code in ended.items():
        print(f"avatar: {name} ended with code {code}; ending the cell", file=sys.stderr)
    codes_of_all = [_end(name, process) for name, process in processes.items()]
    return 0 if not ended and not any(codes_of_all) else 1


def _end(name: str, process: subprocess.Popen[bytes]) -> int:
    """As Ctrl-C would; killed where that does not help."""
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        return process.wait(_STOP_TIMEOUT)
    except subprocess.TimeoutExpired:
        print(f"avatar: {name} did not end in {_STOP_TIMEOUT:g} s and was killed", file=sys.stderr)
        process.kill()
        return process.wait()


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m avatar_ros.nodes.cell")
    parser.add_argument("--params", type=Path)
    for name in sorted({name for names in TAKES.values() for name in names}):
        parser.add_argument(f"--{name}")
    parser.add_argument("--ui", action="store_const", const="yes")
    chosen = vars(parser.parse_args())
    params = chosen.pop("params")
    return run(commands(params, {name: value for name, value in chosen.items() if value}))


if __name__ == "__main__":
    raise SystemExit(main())
