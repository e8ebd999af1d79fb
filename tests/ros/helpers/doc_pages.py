"""Statements of the pages in msg_docs/ and the files in params/, and interfaces of a node."""

from __future__ import annotations

import re
from typing import Any

import yaml
from rclpy.node import NodeNameNonExistentError

from tests.helpers.paths import ROOT

PAGES = ROOT / "msg_docs" / "interfaces"
# Every managed node has these; the index says so in one sentence.
COMMON_TOPICS = {"parameter_events", "rosout", "transition_event"}
COMMON_SERVICES = re.compile(
    r"/(change_state|get_\w*state\w*|get_available_\w+|get_transition_graph"
    r"|\w*parameter\w*|get_type_description)$"
)


def index() -> list[dict[str, str]]:
    """Return rows of the index: interface, page, kind, type, node, direction.

    A heading names the node.
    """
    row = re.compile(
        r"^\[`(?P<interface>[^`]+)`\]\((?P<page>[^)]+)\)"
        r" \| `(?P<type>\w+/(?P<kind>\w+)/\w+)` \| (?P<direction>\w+)$",
        re.MULTILINE,
    )
    sections = (PAGES / "README.md").read_text().split("\n## ")[1:]
    return [
        {**found.groupdict(), "node": section.split("\n")[0]}
        for section in sections
        for found in row.finditer(section)
    ]


def entry(page: str, key: str) -> str:
    """Return the text after ``- **key**:`` on a page."""
    found = re.search(rf"^- \*\*{key}\*\*: (.+)$", (PAGES / page).read_text(), re.MULTILINE)
    assert found, f"{page} does not say its {key}"
    return found[1]


def topic(row: dict[str, str]) -> str:
    return "/" + row["interface"].replace("NAME", "tool")


def offered(graph: Any, node: str) -> set[tuple[str, str, str]]:
    """Return name, type and direction of a node's interfaces, without those that all nodes have."""
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


def parameter_rows(node: str) -> dict[str, str]:
    """Return the name of each documented parameter, and the rest of its row.

    A row of ``support.NAME`` or ``missed.LEVEL`` stands for each name in its code spans.
    """
    page = (PAGES / "parameters.md").read_text()
    section = page.split(f"## {node}\n")[1].split("\n## ")[0]
    rows = {}
    for parameter, rest in re.findall(r"^`([^`]+)` (\|.*)$", section, re.MULTILINE):
        names = re.findall(r"`(\w+)`", rest) if re.search("NAME|LEVEL", parameter) else [""]
        rows |= {re.sub("NAME|LEVEL", name, parameter): rest for name in names}
    return rows


def quality_rows(node: str) -> dict[str, str]:
    """Return each ``qos_overrides`` parameter of a node's topics, with the page's default."""
    found = {}
    for row in index():
        said = entry(row["page"], "QoS") if row["node"] == node and row["kind"] == "msg" else ""
        if "[Overrides]" not in said:
            continue
        side = "subscription" if row["direction"] == "in" else "publisher"
        depth, deadline = re.search(r"depth (\d+)", said), re.search(r"\(([\d.]+) ms\)", said)
        assert depth, row["page"]
        reliability, durability = said.split(".")[0].lower().split(", ")[:2]
        found |= {
            f"qos_overrides.{topic(row)}.{side}.{policy}": value
            for policy, value in (
                ("reliability", reliability),
                ("durability", durability),
                ("depth", depth[1]),
                ("deadline", f"{float(deadline[1]) * 1e6:.0f}" if deadline else "0"),
            )
        }
    return found


def yaml_parameters(node: str) -> dict[str, Any]:
    """Return the parameters in the cell's YAML file, nested names joined by dots."""
    content = yaml.safe_load((ROOT / "params" / "planning_cell.yaml").read_text())
    return _flat(content[node]["ros__parameters"])


def _flat(values: dict[str, Any], before: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{before}{name}.")
        else:
            flat[before + name] = value
    return flat
