"""Nodes that run for as long as a test needs them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from avatar_ros.bench.cell import Module

EXECUTABLES = {
    "contact",
    "effort_bridge",
    "organ_markers",
    "patient_interpolation",
    "planning_ui",
    "slicer_bridge",
    "vademecum_loader",
}


@contextmanager
def running(
    node: str, domain: dict[str, str], *values: str, words: Sequence[str] = ()
) -> Iterator[Module]:
    """Run a node with parameters NAME:=VALUE and other ROS arguments, which has to end well."""
    words = [*words, *(word for value in values for word in ("-p", value))]
    process = Module(node, ["--ros-args", *words] if words else [], domain)
    try:
        yield process
    finally:
        code = process.finish()
    assert code == 0


@contextmanager
def running_cell(
    domain: dict[str, str], library: Path, *values: str, words: Sequence[str] = ()
) -> Iterator[dict[str, Module]]:
    """Run a loader of liver.h5, and a contact node with parameters and other ROS arguments."""
    files = [f"library_dir:={library}", "vademecum:=liver.h5"]
    with ExitStack() as stack:
        loader = stack.enter_context(running("vademecum_loader", domain, *files))
        contact = stack.enter_context(running("contact", domain, *values, words=words))
        yield {"vademecum_loader": loader, "contact": contact}
