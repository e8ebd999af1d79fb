"""A standard service answers any request, and the node goes on."""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from shape_msgs.msg import Mesh, MeshTriangle
from type_description_interfaces.srv import GetTypeDescription

from avatar_interfaces.msg import VademecumInfo
from avatar_ros.framework import qos
from tests.ros.conftest import START_TIMEOUT
from tests.ros.helpers.running import EXECUTABLES, running

INFO, SURFACE = "vademecum_info", "rest_surface"
EXTRAS = {"planning_ui": "viser", "slicer_bridge": "pyigtl"}
NO_ATLAS = {"patient_interpolation": ["autostart:=false"]}
UNKNOWN_TYPE = ParameterValue(type=77)
KINDS = {
    "change_state": ChangeState,
    "get_state": GetState,
    "get_available_states": GetAvailableStates,
    "get_available_transitions": GetAvailableTransitions,
    "get_transition_graph": GetAvailableTransitions,
    "set_parameters": SetParameters,
    "set_parameters_atomically": SetParametersAtomically,
    "get_parameters": GetParameters,
    "get_parameter_types": GetParameterTypes,
    "describe_parameters": DescribeParameters,
    "list_parameters": ListParameters,
    "get_type_description": GetTypeDescription,
}
NAMES = ["", "no.such", "x" * 5000, "a\nb", "\x1b[31m"]


class Client:
    """Client of one node's services, each of which it has discovered before."""

    def __init__(self, probe: Any, node: str) -> None:
        make = probe.node.create_client
        self._clients = {name: make(kind, f"{node}/{name}") for name, kind in KINDS.items()}
        ready = [client.service_is_ready for client in self._clients.values()]
        probe.until(lambda: all(is_ready() for is_ready in ready), START_TIMEOUT)
        self._probe = probe
        probe.ask(GetState, f"{node}/get_state", GetState.Request())

    def __call__(self, name: str, **fields: Any) -> Any:
        answer = self._clients[name].call_async(KINDS[name].Request(**fields))
        self._probe.until(answer.done, 10.0)
        return answer.result()

    def close(self) -> None:
        for client in self._clients.values():
            self._probe.node.destroy_client(client)


@pytest.mark.parametrize("node", sorted(EXECUTABLES))
def test_every_standard_service_answers_what_it_does_not_expect(
    own_domain: dict[str, str], lasting_probe: Any, node: str
) -> None:
    if node in EXTRAS and importlib.util.find_spec(EXTRAS[node]) is None:
        pytest.skip(f"{EXTRAS[node]} is not installed")
    with running(node, own_domain, *NO_ATLAS.get(node, [])):
        ask = Client(lasting_probe, node)
        state = ask("get_state").current_state.label
        assert state == ("unconfigured" if node in NO_ATLAS else "active")
        refuse_transitions(ask)
        refuse_parameters(ask)
        for name in ("get_parameters", "get_parameter_types", "describe_parameters"):
            assert ask(name, names=NAMES)
        assert ask("list_parameters", prefixes=NAMES, depth=2**63)
        assert not ask("get_type_description", type_name="x/y", type_hash="RIHS99_zz").successful
        assert ask("get_available_states").available_states
        assert ask("get_transition_graph").available_transitions
        assert ask("get_state").current_state.label == state
        shut_down = {t.transition.label: t for t in allowed(ask)}["shutdown"].transition
        assert ask("change_state", transition=shut_down).success  # a signal still ends it with 0
        assert not ask("change_state", transition=shut_down).success
        ask.close()


def test_a_message_that_contradicts_itself_is_logged(
    own_domain: dict[str, str], lasting_probe: Any
) -> None:
    make = lasting_probe.node.create_publisher
    with running("organ_markers", own_domain) as node:
        frame, surface = VademecumInfo(), Mesh(vertices=[Point()])
        frame.header.frame_id = "organ"
        surface.triangles = [MeshTriangle(vertex_indices=np.array([0, 1, 7], np.uint32))]
        ends = [make(type(m), t, qos.LATCHED) for m, t in ((frame, INFO), (surface, SURFACE))]
        for end, message in zip(ends, (frame, surface), strict=True):
            end.publish(message)
        lasting_probe.until(lambda: "a message is not taken" in node.said(), START_TIMEOUT)
        assert lasting_probe.ask(GetState, "organ_markers/get_state", GetState.Request())
    for end in ends:
        lasting_probe.node.destroy_publisher(end)


def allowed(ask: Client) -> list[Any]:
    return list(ask("get_available_transitions").available_transitions)


def refuse_transitions(ask: Client) -> None:
    now = {each.transition.id for each in allowed(ask)}
    for number in {*range(12), 30, 61, 99, 255} - now:
        assert not ask("change_state", transition=Transition(id=number)).success
    assert not ask("change_state", transition=Transition(id=1, label="nonsense")).success


def refuse_parameters(ask: Client) -> None:
    """Each is refused separately, with a reason; the others are set."""
    sound = Parameter(name="use_sim_time", value=ParameterValue(type=1, bool_value=False))
    wrong = [Parameter(name=name, value=UNKNOWN_TYPE) for name in ("autostart", "no.such")]
    wrong += [Parameter(name="autostart", value=ParameterValue(type=9))]
    wrong += [Parameter(name="no.such", value=ParameterValue(type=2))]
    results = ask("set_parameters", parameters=[*wrong, sound]).results
    assert [result.successful for result in results] == [False] * 4 + [True]
    assert all(result.reason for result in results[:4])
    assert "no parameter no.such" in results[3].reason
    result = ask("set_parameters_atomically", parameters=[sound, wrong[0]]).result
    assert not result.successful and "77" in result.reason
    result = ask("set_parameters_atomically", parameters=[sound, *wrong]).result
    assert not result.successful and "no parameter no.such" in result.reason
