"""The pages in msg_docs/ and what the nodes offer, compared both ways."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed")
pytest.importorskip("avatar_ros.msg", reason="avatar_ros is not installed")

import yaml
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters
from rclpy.node import NodeNameNonExistentError
from rclpy.parameter import parameter_value_to_python
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from avatar_ros import qos
from avatar_ros.msg import ContactState

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "msg_docs"
NODES = ("vademecum_loader", "contact")
# Every managed node has these; the index says so in one sentence.
COMMON_TOPICS = {"parameter_events", "rosout", "transition_event"}
COMMON_SERVICES = re.compile(
    r"/(change_state|get_\w*state\w*|get_available_\w+|get_transition_graph"
    r"|\w*parameter\w*|get_type_description)$"
)


def _index() -> list[dict[str, str]]:
    """Rows of the index: interface, page, kind, type, node, direction."""
    row = re.compile(
        r"^\| \[`(?P<interface>[^`]+)`\]\((?P<page>[^)]+)\) \| (?P<kind>\w+)"
        r" \| `(?P<type>[^`]+)` \| `(?P<node>[^`]+)` \| (?P<direction>\w+) \|$",
        re.MULTILINE,
    )
    return [found.groupdict() for found in row.finditer((PAGES / "README.md").read_text())]


def _entry(page: str, key: str) -> str:
    """What follows ``- **key**:`` on a page."""
    found = re.search(rf"^- \*\*{key}\*\*: (.+)$", (PAGES / page).read_text(), re.MULTILINE)
    assert found, f"{page} does not say its {key}"
    return found[1]


def _topic(row: dict[str, str]) -> str:
    return "/" + row["interface"].replace("NAME", "tool")


@pytest.fixture
def running(cell: Any, probe: Any) -> Any:
    """A probe beside a cell that is up."""
    probe.next(ContactState, "contact_state", qos.state(1), lambda state: state.vademecum_id)
    return probe


@pytest.mark.parametrize("row", _index(), ids=lambda row: row["interface"])
def test_every_page_is_complete(row: dict[str, str]) -> None:
    assert f"# {row['interface']}\n" in (PAGES / row["page"]).read_text()
    assert row["type"] in _entry(row["page"], "Type")
    for key in ("Kind", "QoS", "Rate", "Frame", "Units"):
        assert _entry(row["page"], key)


def test_every_page_is_in_the_index() -> None:
    pages = {page.name for page in PAGES.glob("*.md")} - {"README.md", "parameters.md"}
    assert pages == {row["page"] for row in _index()}


def _offered(graph: Any, node: str) -> set[tuple[str, str, str]]:
    """Name, type and direction of what a node has beyond what every managed node has."""
    offered = set()
    for direction, ask in (
        ("out", graph.get_publisher_names_and_types_by_node),
        ("in", graph.get_subscriber_names_and_types_by_node),
        ("server", graph.get_service_names_and_types_by_node),
    ):
        try:
            found = ask(node, "/")
        except NodeNameNonExistentError:  # not discovered yet
            return set()
        for name, types in found:
            common = name.rsplit("/", 1)[-1] in COMMON_TOPICS or COMMON_SERVICES.search(name)
            if not common:
                offered.add((name, types[0], direction))
    return offered


@pytest.mark.parametrize("node", NODES)
def test_topics_and_services_are_those_of_the_pages(running: Any, node: str) -> None:
    documented = {
        (_topic(row), row["type"], row["direction"]) for row in _index() if row["node"] == node
    }
    graph = running.node
    # Discovery takes its time: what is missing may still come, what is too much does not go.
    running.until(lambda: _offered(graph, node) >= documented, 20.0, fail=False)
    assert _offered(graph, node) == documented


@pytest.mark.parametrize(
    "row", [row for row in _index() if row["kind"] == "topic"], ids=lambda row: row["interface"]
)
def test_quality_of_service_is_that_of_the_page(running: Any, row: dict[str, str]) -> None:
    graph = running.node
    look = (
        graph.get_subscriptions_info_by_topic
        if row["direction"] == "in"
        else graph.get_publishers_info_by_topic
    )

    def ends() -> list[Any]:
        return [end for end in look(_topic(row)) if end.node_name == row["node"]]

    running.until(lambda: bool(ends()), 20.0)
    (end,) = ends()
    said = _entry(row["page"], "QoS")
    reliable = end.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    latched = end.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert said.startswith("RELIABLE" if reliable else "BEST_EFFORT")
    assert ("TRANSIENT_LOCAL" in said) == latched


@pytest.mark.parametrize("node", NODES)
def test_parameters_are_those_of_the_page(running: Any, node: str) -> None:
    listed = running.call(ListParameters, f"/{node}/list_parameters", ListParameters.Request())
    declared = set(listed.result.names) - {"use_sim_time", "start_type_description_service"}
    page = (PAGES / "parameters.md").read_text()
    section = page.split(f"## {node}\n")[1].split("\n## ")[0]
    rows = dict(re.findall(r"^\| `([^`]+)` (\|.*)$", section, re.MULTILINE))
    assert declared == set(rows)
    request = DescribeParameters.Request(names=sorted(declared))
    described = running.call(DescribeParameters, f"/{node}/describe_parameters", request)
    for descriptor in described.descriptors:
        assert descriptor.description
        changeable = "may change while running" in rows[descriptor.name]
        assert descriptor.read_only != changeable, descriptor.name


def test_the_yaml_file_holds_every_parameter_at_its_default(running: Any) -> None:
    content = yaml.safe_load((ROOT / "params" / "contact.yaml").read_text())
    values = _flat(content["contact"]["ros__parameters"])
    request = GetParameters.Request(names=list(values))
    answer = running.call(GetParameters, "/contact/get_parameters", request)
    running_with = [parameter_value_to_python(value) for value in answer.values]
    assert dict(zip(values, running_with, strict=True)) == values
    listed = running.call(ListParameters, "/contact/list_parameters", ListParameters.Request())
    declared = set(listed.result.names) - {"use_sim_time", "start_type_description_service"}
    assert declared == set(values)


def _flat(values: dict[str, Any], before: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{before}{name}.")
        else:
            flat[before + name] = value
    return flat
