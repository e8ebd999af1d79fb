"""Two hosts on one machine: network namespaces joined by a wire, without shared memory."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest


class Hosts:
    """``planning`` and ``haptic``, and the processes on them.

    Parameters
    ----------
    folder : Path
        Shared memory of ``haptic``.
    environment : dict
        Default environment of processes.
    hidden : Path, optional
        Folder that is empty on ``haptic``.
    """

    ADDRESS = "10.77.0.1"  # address of planning

    def __init__(self, folder: Path, environment: dict[str, str], hidden: Path | None) -> None:
        mark = f"{os.getpid() % 100000}"
        self.names = {"planning": f"avp{mark}", "haptic": f"avh{mark}"}
        self._environment = environment
        self._shm = folder / "shm"
        self._shm.mkdir()
        mounts = [f"mount --bind {self._shm} /dev/shm"]
        mounts += [f"mount -t tmpfs none {hidden}"] if hidden is not None else []
        self._mounts = " && ".join(mounts)
        self._processes: list[subprocess.Popen[str]] = []
        for name in self.names.values():
            _ip(f"netns add {name}")
            _ip(f"-n {name} link set lo up")
        planning, haptic = self.names.values()
        _ip(f"link add far0 netns {planning} type veth peer far0 netns {haptic}")
        for k, name in enumerate((planning, haptic), 1):
            _ip(f"-n {name} address add 10.77.0.{k}/24 dev far0")
            _ip(f"-n {name} link set far0 up")
            _ip(f"-n {name} route add 224.0.0.0/4 dev far0")

    def run(
        self, host: str, *command: str, environment: dict[str, str] | None = None
    ) -> subprocess.Popen[str]:
        """Start a Python command."""
        words = ["ip", "netns", "exec", self.names[host], sys.executable, *command]
        if host == "haptic":
            words = ["unshare", "-m", "sh", "-c", f'{self._mounts} && exec "$@"', "sh", *words]
        env = self._environment if environment is None else environment
        process = subprocess.Popen(words, cwd="/", env=env, stdout=subprocess.PIPE, text=True)
        self._processes.append(process)
        return process

    def link(self, state: str) -> None:
        """Set the wire "up" or "down"."""
        _ip(f"-n {self.names['planning']} link set far0 {state}")
        if state == "up":
            with suppress(subprocess.CalledProcessError):
                _ip(f"-n {self.names['planning']} route add 224.0.0.0/4 dev far0")

    def close(self) -> None:
        """End the processes, and remove the hosts."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
        for name in self.names.values():
            subprocess.run(["ip", "netns", "del", name], check=False)


@contextmanager
def two_hosts(
    folder: Path, environment: dict[str, str], hidden: Path | None = None
) -> Iterator[Hosts]:
    """Make two hosts, or skip the test without the right to make them."""
    if not _may():
        pytest.skip("no right to make network namespaces")
    found = Hosts(folder, environment, hidden)
    try:
        yield found
    finally:
        found.close()


def _ip(words: str) -> None:
    subprocess.run(["ip", *words.split()], check=True, capture_output=True)


def _may() -> bool:
    if shutil.which("ip") is None or shutil.which("unshare") is None:
        return False
    tried = subprocess.run(["unshare", "-n", "-m", "true"], check=False, capture_output=True)
    return tried.returncode == 0 and os.access("/run", os.W_OK)
