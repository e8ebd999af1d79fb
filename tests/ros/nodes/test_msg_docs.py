"""The pages in msg_docs/ and the interfaces of the nodes, compared both ways."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
from rcl_interfaces.srv import DescribeParameters
from rclpy.duration import Infinite
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from avatar_interfaces.msg import ContactState
from avatar_ros.bench.cell import Module
from avatar_ros.framework import qos
from tests.ros.conftest import newcomer
from tests.ros.helpers.doc_pages import (
    PAGES,
    entry,
    index,
    offered,
    parameter_rows,
    quality_rows,
    topic,
    yaml_parameters,
)
from tests.ros.helpers.parameters import parameter_names, parameter_values

NODES = ("vademecum_loader", "contact", "organ_markers")
# some of the contact node's topics exist only with these
ASKED = {"tool_operating_state": True, "tool_state_command": "enable"}
OVERRIDABLE = NODES[:2]  # nodes whose quality of service parameters may change


@pytest.fixture(scope="module")
def cell(own_domain: dict[str, str]) -> Iterator[list[Module]]:
    """Start the nodes with their defaults, and with the parameters that give all topics."""
    values = [word for name, value in ASKED.items() for word in ("-p", f"{name}:={value}")]
    arguments = {"contact": ["--ros-args", *values]}
    processes = [Module(node, arguments.get(node, []), own_domain) for node in NODES]
    yield processes
    assert [process.finish() for process in processes] == [0] * len(NODES)


@pytest.fixture(scope="module")
def probe(lasting_probe: Any) -> Any:
    return lasting_probe


def documented(node: str) -> set[tuple[str, str, str]]:
    """Return name, type and direction of a node's interfaces in the index."""
    return {(topic(row), row["type"], row["direction"]) for row in index() if row["node"] == node}


@pytest.fixture(scope="module")
def graph(cell: Any) -> Iterator[Any]:
    """Make a node that discovered all that the pages list."""
    with newcomer(lambda graph: all(offered(graph, n) >= documented(n) for n in NODES)) as probe:
        yield probe.node


@pytest.fixture
def running(cell: Any, probe: Any) -> Any:
    """Return a probe beside a cell that is up."""
    probe.next(ContactState, "contact_state", qos.state(1))
    return probe


@pytest.mark.parametrize("row", index(), ids=lambda row: row["interface"])
def test_every_page_is_complete(row: dict[str, str]) -> None:
    assert f"# {row['interface']}\n" in (PAGES / row["page"]).read_text()
    assert {row["type"], row["node"]} <= set(re.findall(r"`([^`]+)`", entry(row["page"], "Type")))
    for key in ("QoS", "Rate", "Frame", "Units"):
        assert entry(row["page"], key)


def test_every_page_is_in_the_index() -> None:
    pages = {page.name for page in PAGES.glob("*.md") if "\n- **Type**:" in page.read_text()}
    assert pages == {row["page"] for row in index()}


def test_the_index_names_every_page() -> None:
    named = set(re.findall(r"\]\((\w+\.md)[)#]", (PAGES / "README.md").read_text()))
    assert named == {page.name for page in PAGES.glob("*.md")} - {"README.md"}


@pytest.mark.parametrize("node", NODES)
def test_topics_and_services_are_those_of_the_pages(graph: Any, node: str) -> None:
    # other nodes may hear it: its page is that of its sender
    heard = {(topic(row), row["type"], "in") for row in index() if row["direction"] == "out"}
    assert offered(graph, node) - heard == documented(node)


@pytest.mark.parametrize(
    "row", [row for row in index() if row["kind"] == "msg"], ids=lambda row: row["interface"]
)
def test_quality_of_service_is_that_of_the_page(graph: Any, row: dict[str, str]) -> None:
    look = (
        graph.get_subscriptions_info_by_topic
        if row["direction"] == "in"
        else graph.get_publishers_info_by_topic
    )
    (end,) = (end for end in look(topic(row)) if end.node_name == row["node"])
    said = entry(row["page"], "QoS")
    reliable = end.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    latched = end.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert said.startswith("RELIABLE" if reliable else "BEST_EFFORT")
    assert ("TRANSIENT_LOCAL" in said) == latched
    deadline = end.qos_profile.deadline
    assert ("deadline of" in said) == (deadline < Infinite)
    if deadline < Infinite:
        assert f"({deadline.nanoseconds * 1e-6:g} ms)" in said


@pytest.mark.parametrize("node", NODES)
def test_parameters_are_those_of_the_page(running: Any, node: str) -> None:
    rows, quality = parameter_rows(node), quality_rows(node)
    assert bool(quality) == (node in OVERRIDABLE)
    assert parameter_names(running, node) == set(rows) | set(quality)
    found = parameter_values(running, node, quality)
    assert quality == {name: str(value) for name, value in found.items()}
    request = DescribeParameters.Request(names=sorted(rows))
    described = running.ask(DescribeParameters, f"/{node}/describe_parameters", request)
    for descriptor in described.descriptors:
        assert descriptor.description
        changeable = "*live*" in rows[descriptor.name]
        assert descriptor.read_only != changeable, descriptor.name


def test_the_yaml_file_holds_every_parameter_at_its_default(running: Any) -> None:
    values = yaml_parameters("contact")
    assert parameter_values(running, "contact", values) == values | ASKED
    assert parameter_names(running, "contact") == set(values)
