"""Requests of the planning page, which its users make in separate threads."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from threading import Thread
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.action import ActionServer

from avatar_interfaces.action import BuildPatient
from avatar_ros.ui.session.alerts import alerts_of_switch
from avatar_ros.ui.session.requests import Requests, Wanted
from tests.ros.conftest import Probe
from tests.ros.helpers.page import Noted

AWAY = 0.5  # pause of a thread right after it sent a goal: the answer comes meanwhile [s]


class Slow:
    """The middleware's client of an action, which keeps its caller after a goal is sent."""

    def __init__(self, handle: Any) -> None:
        self._handle = handle

    def __getattr__(self, name: str) -> Any:
        return getattr(self._handle, name)

    def __enter__(self) -> Any:
        return self._handle.__enter__()

    def __exit__(self, *given: Any) -> Any:
        return self._handle.__exit__(*given)

    def send_goal_request(self, request: Any) -> int:
        number = int(self._handle.send_goal_request(request))
        time.sleep(AWAY)
        return number


def build_at_once(goal: Any) -> BuildPatient.Result:
    goal.succeed()
    return BuildPatient.Result(success=True, file="case.h5", notices=["read label 1, 5 ml"])


@pytest.fixture
def until_built(probe: Probe) -> Iterator[Callable[[list[Any], list[str]], None]]:
    """Ask for a patient in a separate thread, and spin until there is a result."""
    requests = Requests(probe.node)

    def ask(results: list[Any], said: list[str]) -> None:
        probe.until(lambda: "patient_interpolation" not in requests.missing, 60.0)
        requests._build._client_handle = Slow(requests._build._client_handle)
        given = (Wanted("case.stl"), lambda *stage: None, said.append, results.append)
        Thread(target=requests.build_patient, args=given).start()
        probe.until(lambda: bool(results), 20.0)

    with closing(Probe()) as builder:
        action = ActionServer(builder.node, BuildPatient, "build_patient", build_at_once)
        thread = Thread(target=builder._executor.spin, daemon=True)
        thread.start()
        yield ask
        requests.close()
        builder._executor.shutdown()
        thread.join()
        action.destroy()


def test_the_end_of_a_build_is_heard_however_early_the_goal_is_accepted(until_built: Any) -> None:
    results: list[Any] = []
    said: list[str] = []
    until_built(results, said)
    assert [result.file for result in results] == ["case.h5"]
    assert said == ["case.h5 built in 0 s; read label 1, 5 ml"]


class Silent:
    """Client of a node that ends before it answers."""

    def __init__(self) -> None:
        self.asked: list[float] = []

    def service_is_ready(self) -> bool:
        return True

    def call_async(self, request: Any) -> Any:
        self.asked.append(request.parameters[0].value.double_value)
        return SimpleNamespace(add_done_callback=lambda answered: None)


def test_a_contact_node_that_starts_again_is_asked_again() -> None:
    silent, requests = Silent(), Requests.__new__(Requests)  # without a node
    requests.__dict__ |= {"_set": silent, "_waiting": {}, "_setting": False}
    for young in (1e3, 2e3, 3e3):
        requests.set_material({"young": young}, print)
    assert silent.asked == [1e3]  # the others wait for its answer
    assert requests.is_setting
    requests.contact_started()
    assert not requests.is_setting
    requests.set_material({"young": 4e3}, print)
    assert silent.asked == [1e3, 4e3]


def test_a_scene_that_is_being_prepared_is_said_until_it_is_in_use() -> None:
    requests, asked = Requests.__new__(Requests), list[Any]()
    ready = Noted(service_is_ready=lambda: True, call_async=lambda request: ready)
    ready._answers["add_done_callback"] = asked.append
    requests.__dict__ |= {"_load_scene": ready, "_switch": None}
    assert alerts_of_switch(requests.switching, "bare", False) == []
    for name in ("breathing", "palpation"):
        requests.load_scene(name, print)
    (alert,) = alerts_of_switch(requests.switching, "bare", False)
    assert alert == "Scene palpation is being prepared, 0 s; still in force: bare"
    (alert,) = alerts_of_switch(requests.switching, "bare", True)
    assert alert.endswith("the recording begins after it")
    for answered, left in zip(asked, (True, False), strict=True):
        answered(SimpleNamespace(result=lambda: None))
        assert (requests.switching is not None) is left


def building() -> tuple[Requests, list[Any], list[str]]:
    """Return a running build, its results, and its messages."""
    requests, results, said = Requests.__new__(Requests), [], []
    ready = SimpleNamespace(
        server_is_ready=lambda: True,
        send_goal_async=lambda *given: SimpleNamespace(add_done_callback=lambda accepted: None),
    )
    at_once = SimpleNamespace(executor=SimpleNamespace(create_task=lambda do: do()))
    requests.__dict__ |= {"_build": ready, "_pending": None, "_goal": None, "_node": at_once}
    requests.build_patient(Wanted("a.obj"), lambda *stage: None, said.append, results.append)
    return requests, results, said


def test_a_build_whose_node_ends_comes_to_nothing() -> None:
    requests, results, said = building()
    requests.builder_is_missing()
    requests.builder_is_missing()  # once a second
    assert results == [None]
    assert len(said) == 1 and "ended; the node that builds patients is not running" in said[0]


def test_a_second_build_is_refused_and_the_first_one_goes_on() -> None:
    requests, results, said = building()
    requests.build_patient(Wanted("b.obj"), lambda *stage: None, said.append, results.append)
    assert results == [] and said == ["a patient is being built already; cancel it first"]
