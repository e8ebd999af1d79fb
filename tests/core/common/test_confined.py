"""Calls in a process that may die."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from threading import Thread
from typing import Any

import numpy as np
import pytest

from avatar_core.common.child import Child, EndedError
from avatar_core.common.confined import Confined, ConfinedError, Imported
from avatar_core.common.processes import ModuleProcess
from avatar_core.errors import StorageError
from avatar_core.vademecum.storage import load_vademecum
from tests.helpers.processes import state_of
from tests.helpers.slowness import within

SECONDS = 20.0


@pytest.fixture
def confined() -> Iterator[Confined]:
    caller = Confined(1 << 30)
    yield caller
    caller.close()


def test_a_call_gives_what_the_function_gives(confined: Confined) -> None:
    made = confined.call(SECONDS, np.linspace, 0.0, 1.0, num=5)
    np.testing.assert_array_equal(made, [0.0, 0.25, 0.5, 0.75, 1.0])


def test_a_function_by_its_name_is_imported_there_alone(
    confined: Confined, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    named = Imported("colorsys", "rgb_to_yiq")
    assert confined.call(SECONDS, named, 0.0, 0.0, 0.0) == (0.0, 0.0, 0.0)
    assert "colorsys" not in sys.modules


def test_what_was_loaded_is_there_before_the_first_call(confined: Confined) -> None:
    confined.load(Imported("colorsys", "rgb_to_yiq"))
    loaded = confined.pid
    assert confined.call(SECONDS, eval, "'colorsys' in __import__('sys').modules")
    assert confined.pid == loaded
    with pytest.raises(ConfinedError):
        confined.load(Imported("no_such_module", "f"))
    assert confined.call(SECONDS, int, "1") == 1


def test_an_error_of_ours_comes_back_as_it_is(confined: Confined) -> None:
    with pytest.raises(StorageError, match="no vademecum at /none"):
        confined.call(SECONDS, load_vademecum, "/none")


def test_another_error_comes_back_in_a_line(confined: Confined) -> None:
    with pytest.raises(ConfinedError, match="invalid literal"):
        confined.call(SECONDS, int, "x")


def test_a_crash_is_an_error_and_the_next_call_works(confined: Confined) -> None:
    first = confined.call(SECONDS, os.getpid)
    with pytest.raises(ConfinedError, match="Segmentation fault"):
        confined.call(SECONDS, os.kill, first, signal.SIGSEGV)
    assert confined.call(SECONDS, os.getpid) not in (first, os.getpid())


def test_a_call_is_given_up_by_another_thread(confined: Confined) -> None:
    first = confined.call(SECONDS, os.getpid)

    def give_up() -> None:
        while state_of(first) != "T":
            time.sleep(0.01)
        confined.kill()

    giving_up = Thread(target=give_up)
    giving_up.start()
    with pytest.raises(ConfinedError, match="Killed"):
        confined.call(SECONDS, os.kill, first, signal.SIGSTOP)
    giving_up.join()
    assert confined.call(SECONDS, os.getpid) != first
    Confined().kill()  # without a process


@pytest.mark.parametrize("hang", [(time.sleep, 60.0), (sum, range(10**12))])
def test_a_hang_is_an_error_and_the_next_call_works(confined: Confined, hang: Any) -> None:
    confined.call(SECONDS, os.getpid)
    with within(15.0), pytest.raises(ConfinedError, match="longer than 1 s"):
        confined.call(1.0, *hang)
    assert confined.call(SECONDS, os.getpid) == confined.pid


def test_time_in_which_others_compute_does_not_count(confined: Confined) -> None:
    confined.call(1.0, time.sleep, 2.0)


def test_memory_has_a_limit(confined: Confined) -> None:
    with pytest.raises(ConfinedError, match="allocate"):
        confined.call(SECONDS, np.empty, 2 << 30, np.uint8)
    assert confined.call(SECONDS, np.empty, 1 << 20, np.uint8).size == 1 << 20


@pytest.mark.parametrize("is_held", [False, True])
def test_the_process_ends_with_the_caller(is_held: bool) -> None:
    confined = Confined()
    number = confined.call(SECONDS, os.getpid)
    if is_held:  # it cannot take the signal to end
        os.kill(number, signal.SIGSTOP)
    confined.close()
    with pytest.raises(ProcessLookupError):
        os.kill(number, 0)
    confined.close()


def test_a_child_is_started_again_and_says_how_it_ended() -> None:
    child = Child("avatar_core.common.confined", str(1 << 30))
    assert child.finish(1.0) == "it was not started"
    with pytest.raises(EndedError):
        child.send(int)
    for number, end in ((signal.SIGSEGV, "Segmentation fault"), (signal.SIGTERM, "Terminated")):
        child.start()
        child.send(os.getpid)
        assert child.receive() is None  # it could be imported
        first = child.pid
        child.start()  # it runs
        assert child.pid == first
        child.send_signal(number)
        with pytest.raises(EndedError, match=end):
            child.receive()
        assert child.pid is None and not child.is_running
        assert child.finish(1.0) == end


def test_a_child_without_its_module_says_its_exit_code() -> None:
    child = Child("avatar_core.no_such_module", stderr=subprocess.DEVNULL)
    child.start()
    with pytest.raises(EndedError, match="exit code 1"):
        child.receive()


def test_a_signal_while_a_child_starts_leaves_none_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    """The handler raises only once the process is known to the code that must end it."""

    def stop(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    def started_as_a_signal_comes(*arguments: Any, **options: Any) -> ModuleProcess:
        process = ModuleProcess(*arguments, **options)
        signal.raise_signal(signal.SIGTERM)
        return process

    before = signal.signal(signal.SIGTERM, stop)
    monkeypatch.setattr("avatar_core.common.child.ModuleProcess", started_as_a_signal_comes)
    child = Child("avatar_core.common.confined", str(1 << 30))
    try:
        with pytest.raises(KeyboardInterrupt):
            child.start()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert child.is_running
    child.finish(5.0)
