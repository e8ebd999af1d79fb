"""YAML as nodes with file and line, which error messages name.

The YAML library only builds the tree of nodes; nothing in a file chooses what is constructed. Files
larger than ``MAX_BYTES`` are not even opened.
"""

from __future__ import annotations

import difflib
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from avatar_core.errors import SceneError, one_line

MAX_BYTES = 64 * 1024
MAX_DEPTH = 8  # a scene needs 6
_UNKNOWN = "it cannot be understood"

_TAGS = {
    f"tag:yaml.org,2002:{kind}"
    for kind in ("map", "seq", "str", "int", "float", "bool", "null", "timestamp")
}
_NULL = "tag:yaml.org,2002:null"

Entries = dict[str, tuple[Node, Node]]  # by key: the nodes of the key and of its value


def read_text(path: Path) -> str:
    """Return the text of a small, ordinary file; others are not opened.

    Raises
    ------
    SceneError
        Naming the file.
    """
    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode):
            raise SceneError(f"{path}: is not a file; check the path")
        _check_size(about.st_size, str(path))
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)  # it may have grown
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    _check_size(len(content), str(path))
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise SceneError(f"{path}:{line}: is not UTF-8 text; save it as UTF-8") from error


def compose(text: str, source: str) -> Node:
    """Return the root node of one YAML document.

    Raises
    ------
    SceneError
        Naming source and line: not YAML, empty, too long, aliases, foreign tags, deep nesting.
    """
    _check_size(len(text), source)
    try:
        loader = _Loader(text)
        loader.name = source
        root = loader.get_single_node()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        raise SceneError(
            f"{source}:{line}: is not YAML: {one_line(error.problem or _UNKNOWN, 120)}"
        ) from error
    except yaml.reader.ReaderError as error:
        line = text.count("\n", 0, error.position) + 1
        raise SceneError(
            f"{source}:{line}: is not YAML: {one_line(error.reason or _UNKNOWN, 120)}"
        ) from error
    if root is None:
        raise SceneError(f"{source}:1: is empty; write at least 'name: ...'")
    return root


class _Loader(yaml.SafeLoader):
    """Composes nodes; refuses aliases, which can expand to billions of nodes, and deep nesting."""

    depth = 0

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            raise refused(event, "aliases (*) are not read; write the value out")
        if self.depth == MAX_DEPTH:
            raise refused(event, f"is nested more than {MAX_DEPTH} deep; no scene is")
        if event.tag is not None and event.tag not in _TAGS:
            raise refused(event, f"the tag {event.tag[:60]} is not read; remove it")
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


def refused(place: Any, message: str) -> SceneError:
    """Return an error that names file and line of a node or an event."""
    mark = place.start_mark
    return SceneError(f"{mark.name}:{mark.line + 1}: {message}")


@contextmanager
def placed_at(node: Node) -> Iterator[None]:
    """Add file and line of a node to errors raised inside."""
    try:
        yield
    except SceneError as error:
        raise refused(node, str(error)) from error


def entries_of(node: Node, owner: str, known: Sequence[str]) -> Entries:
    """Return the entries of a mapping; see :func:`checked`."""
    if not isinstance(node, MappingNode):
        wanted = (
            f"write 'key: value' below it, of {', '.join(known)}" if known else "it has no settings"
        )
        raise refused(node, f"{owner or 'the scene'} is {shown(node)}; {wanted}")
    return checked(node.value, owner, known)


def checked(pairs: Iterable[tuple[Node, Node]], owner: str, known: Sequence[str]) -> Entries:
    """Return the entries; raises SceneError for an unknown key or one that is given twice."""
    found: Entries = {}
    for key, value in pairs:
        path = below(owner, shown(key))
        if not isinstance(key, ScalarNode) or key.value not in known:
            raise refused(key, f"{path} is unknown; {_instead(shown(key), known)}")
        if key.value in found:
            line = found[key.value][0].start_mark.line + 1
            raise refused(key, f"{path} is given twice, first in line {line}; remove one")
        found[key.value] = (key, value)
    return found


def _instead(word: str, known: Sequence[str]) -> str:
    if not known:
        return "it has no settings"
    close = difflib.get_close_matches(word, known, 1)
    guess = f"did you mean '{close[0]}'? " if close else ""
    return f"{guess}known: {', '.join(known)}"


def below(owner: str, key: str) -> str:
    """Return the path of a key in error messages."""
    return f"{owner}.{key}" if owner else key


def nothing_at(node: Node) -> Node:
    """Return a node without a value, at the position of another."""
    return ScalarNode(_NULL, "", node.start_mark, node.end_mark)


def is_nothing(node: Node) -> bool:
    """Return whether a key has no value."""
    return bool(node.tag == _NULL)


def shown(node: Node) -> str:
    """Return a node for an error message: short and in one line."""
    if not isinstance(node, ScalarNode):
        return "a list" if isinstance(node, SequenceNode) else "a mapping"
    text = " ".join(node.value.split())[:40]
    return (text or "empty") if node.style is None else f"'{text}' in quotes"


def _check_size(size: int, source: str) -> None:
    if size > MAX_BYTES:
        raise SceneError(
            f"{source}: has {size} bytes; at most {MAX_BYTES} are read: is it the right file?"
        )
