"""Scenes as YAML. Errors name the line; what is written reads back equal.

Names, types, ranges and units come from the dataclasses: a new effect needs no change here.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from avatar_core.common.dataclass_json import plain
from avatar_core.common.files import shipped_files
from avatar_core.common.quantities import check_line, is_whole, lies_in
from avatar_core.contact.effects import EFFECTS, Effect, Viscoelasticity
from avatar_core.errors import SceneError
from avatar_core.geometry.tip import Jaw, Tip
from avatar_core.scene.model import Scene, SupportStiffness, Tool
from avatar_core.scene.prony import parse_prony
from avatar_core.scene.yaml_lines import (
    Entries,
    below,
    checked,
    compose,
    entries_of,
    is_nothing,
    nothing_at,
    placed_at,
    read_text,
    refused,
    shown,
)

# Fields of a Scene by the key that groups them in YAML; the other keys have no group.
SECTIONS = {
    "organ": ("vademecum",),
    "material": ("young_modulus", "poisson_ratio", "supports", "resection"),
    "outputs": ("cloud", "cloud_divisor", "modes"),
}
SHIPPED = "scenes"  # folder of the shipped scenes
_KEYS = ("name", "text", "organ", "material", "tools", "outputs", "effects")


def shipped_scenes() -> dict[str, Path]:
    """Return the files of the scenes that come with the project, by name without suffix; sorted."""
    return shipped_files(SHIPPED)


def shipped_scene(name: str) -> Path:
    """Return the file of a shipped scene, by name, with or without ``.yaml``.

    Raises
    ------
    SceneError
        If there is no scene of that name, or the name is a path; lists the shipped scenes.
    """
    known = shipped_scenes()
    if (stem := name.removesuffix(".yaml")) not in known:
        raise SceneError(
            f"there is no scene {name!r}; choose one of those that come with avatar: "
            f"{', '.join(known) or 'none is installed'}"
        )
    return known[stem]


def scene_path(name: str) -> Path:
    """Return the file of a scene: a path, or the name of a shipped scene.

    Raises SceneError like :func:`shipped_scene`, for a name without folder and suffix.
    """
    path = Path(name)
    is_path = path.is_file() or path.name != name or bool(path.suffix)
    return path if is_path else shipped_scene(name)


def read_scene(path: str | Path) -> Scene:
    """Read a scene; see :func:`parse_scene`. Files of Prony terms must lie in the same folder.

    Examples
    --------
    >>> _ = open("touch.yaml", "w").write("{name: touch, effects: {friction: {}}}")
    >>> av.read_scene("./touch.yaml").effect("friction").static
    0.4
    """
    path = Path(path)
    return parse_scene(read_text(path), str(path), path.parent)


def parse_scene(text: str, source: str, folder: Path | None = None) -> Scene:
    """Return the scene that YAML text describes; a key without a value keeps its default.

    Parameters
    ----------
    text : str
        YAML.
    source : str
        Name of the text in error messages.
    folder : Path or None
        Folder in which files that the text names must lie; None if it may name no file.

    Raises
    ------
    SceneError
        In one line: source, line number, key, value, and allowed values.
    """
    root = compose(text, source)
    entries = entries_of(root, "", _KEYS)
    values: dict[str, Any] = {}
    for key, (_, node) in entries.items():
        if is_nothing(node):
            continue
        if key in SECTIONS:
            values |= _fields(Scene, entries_of(node, key, SECTIONS[key]), key)
        elif key == "tools":
            values[key] = _tools(node)
        elif key == "effects":
            values[key] = _effects(node, folder)
        else:
            values[key] = _value(node, key, Scene, key)
    with placed_at(entries["tools"][0] if "tools" in entries else root):
        return Scene(**values)


def write_scene(scene: Scene) -> str:
    """Return YAML text that :func:`parse_scene` reads as an equal scene; it names no other file."""
    document: dict[str, Any] = {"name": scene.name, "text": scene.text}
    for section, keys in SECTIONS.items():
        values = {key: getattr(scene, key) for key in keys}
        chosen = {k: v for k, v in values.items() if v is not None and not isinstance(v, tuple)}
        document[section] = {key: plain(value) for key, value in chosen.items()}
    if scene.supports:
        document["material"]["supports"] = {s.name: float(s.stiffness) for s in scene.supports}
    document["tools"] = [_plain_tool(tool) for tool in scene.tools]
    document["effects"] = {effect.name: _plain_fields(effect) for effect in scene.effects}
    return yaml.safe_dump(
        document, sort_keys=False, allow_unicode=True, default_flow_style=None, width=math.inf
    )


def _plain_tool(tool: Tool) -> dict[str, Any]:
    jaw = tool.tip.grasp
    found = {"name": tool.name, "tip": _plain_fields(replace(tool.tip, grasp=None))}
    return found | ({"grasp": _plain_fields(jaw)} if jaw else {})


def _plain_fields(one: Any) -> dict[str, Any]:
    """Return the fields of a dataclass that have a value."""
    values = {field.name: getattr(one, field.name) for field in fields(one)}
    return {name: plain(value) for name, value in values.items() if value is not None}


def _fields(owner: type, entries: Entries, path: str) -> dict[str, Any]:
    """Return the values of the fields of a dataclass; fields without a value are left out."""
    return {
        key: _value(node, below(path, key), owner, key)
        for key, (_, node) in entries.items()
        if not is_nothing(node)
    }


def _value(node: Node, path: str, owner: type, key: str) -> Any:
    """Return the value of a node, of the type that the field has."""
    kind = get_type_hints(owner)[key]
    if kind == tuple[SupportStiffness, ...]:
        return _supports(node, path)
    if kind is str:
        return _line(node, path)
    if get_origin(kind) is not None and isinstance(get_args(kind)[0], str):
        return _choice(node, path, get_args(kind))
    (allowed,) = (f.metadata["quantity"] for f in fields(owner) if f.name == key)
    if get_origin(kind) is not tuple:
        return _number(node, path, allowed, is_whole(owner, key))
    if not isinstance(node, SequenceNode):
        raise refused(node, f"{path} is {shown(node)}; write a list of numbers in {allowed}")
    return tuple(_number(item, f"{path}[{i}]", allowed, False) for i, item in enumerate(node.value))


def _supports(node: Node, path: str) -> tuple[SupportStiffness, ...]:
    """Return a mapping of the supports' names to their stiffnesses."""
    if not isinstance(node, MappingNode):
        raise refused(node, f"{path} is {shown(node)}; write {{bare_area: 1e6}}, [N/m^3]")
    (field,) = (f for f in fields(SupportStiffness) if f.name == "stiffness")
    entries = checked(node.value, path, [str(key.value) for key, _ in node.value])
    return tuple(
        SupportStiffness(name, _number(value, below(path, name), field.metadata["quantity"], False))
        for name, (_, value) in entries.items()
    )


def _number(node: Node, path: str, allowed: Any, whole: bool) -> float:
    """Return a number; unquoted text like 20e-3, which YAML 1.1 reads as text, is accepted."""
    value = math.nan
    is_number = isinstance(node, ScalarNode) and node.style is None
    try:
        value = float(node.value) if is_number else value
    except ValueError:
        is_number = False
    if whole and value.is_integer():
        value = int(value)
    if not lies_in(value, allowed, whole):
        kind = "be a whole number in" if whole else "lie in" if is_number else "be a number in"
        raise refused(node, f"{path} is {shown(node)}; it must {kind} {allowed}")
    return value


def _line(node: Node, path: str) -> str:
    if not isinstance(node, ScalarNode):
        raise refused(node, f"{path} is {shown(node)}; write one line of text")
    text = node.value.rstrip("\n")  # of > and |
    with placed_at(node):
        check_line(path, text)
    return text


def _choice(node: Node, path: str, choices: Sequence[str]) -> str:
    """Return one of several words, as written: YAML 1.1 reads off as false."""
    if not isinstance(node, ScalarNode) or node.value not in choices:
        raise refused(node, f"{path} is {shown(node)}; it must be one of {', '.join(choices)}")
    return node.value


def _tools(node: Node) -> tuple[Tool, ...]:
    known = [*(field.name for field in fields(Tool)), "grasp"]
    if not isinstance(node, SequenceNode):
        raise refused(node, f"tools is {shown(node)}; write a list of {{{': , '.join(known)}: }}")
    return tuple(_tool(item, f"tools[{i}]", known) for i, item in enumerate(node.value))


def _tool(node: Node, path: str, known: Sequence[str]) -> Tool:
    entries = entries_of(node, path, known)
    _, tip = entries.pop("tip", (None, None))
    _, jaw = entries.pop("grasp", (None, None))
    values = _fields(Tool, entries, path)
    of_tip: dict[str, Any] = {}
    if jaw is not None:
        of_tip["grasp"] = Jaw() if is_nothing(jaw) else _part(Jaw, jaw, below(path, "grasp"))
    if tip is not None and not is_nothing(tip):
        values["tip"] = _part(Tip, tip, below(path, "tip"), **of_tip)
    elif of_tip:
        values["tip"] = Tip(**of_tip)
    with placed_at(node):
        return Tool(**values)


def _part(kind: type, node: Node, path: str, **given: Any) -> Any:
    """Return a tip or a jaw from its numbers and further given values."""
    known = [field.name for field in fields(kind) if field.name not in ("grasp", *given)]
    values = _fields(kind, entries_of(node, path, known), path)
    with placed_at(node):
        return kind(**values, **given)


def _effects(node: Node, folder: Path | None) -> tuple[Effect, ...]:
    """Return the effects from a mapping, or from a list of names and mappings of one key."""
    if isinstance(node, SequenceNode):
        pairs = [_named(item) for item in node.value]
    elif isinstance(node, MappingNode):
        pairs = node.value
    else:
        raise refused(node, f"effects is {shown(node)}; write a list: [{', '.join(EFFECTS)}]")
    entries = checked(pairs, "effects", tuple(EFFECTS))
    return tuple(_effect(name, *entry, folder) for name, entry in entries.items())


def _named(item: Node) -> tuple[Node, Node]:
    if isinstance(item, MappingNode) and len(item.value) == 1:
        return item.value[0]
    if isinstance(item, ScalarNode):
        return item, nothing_at(item)
    raise refused(item, f"effects holds {shown(item)}; write a name, or 'name: settings'")


def _effect(name: str, key: Node, node: Node, folder: Path | None) -> Effect:
    kind = EFFECTS[name]
    known = [field.name for field in fields(kind)]
    if kind is Viscoelasticity:
        known.append("file")
    entries = {} if is_nothing(node) else entries_of(node, name, known)
    file_key, file = entries.pop("file", (key, nothing_at(key)))
    values = _fields(kind, entries, name)
    if not is_nothing(file):
        if values:
            raise refused(file_key, f"{name} has file and {', '.join(values)}; leave one out")
        values = _prony_beside(file, f"{name}.file", folder)
    for field in fields(kind):
        if field.default is MISSING and field.name not in values:
            allowed = field.metadata["quantity"]
            raise refused(key, f"{name}.{field.name} is missing; give numbers in {allowed}")
    with placed_at(key):
        return kind(**values)


def _prony_beside(node: Node, path: str, folder: Path | None) -> dict[str, tuple[float, ...]]:
    name = _line(node, path)
    if folder is None:
        raise refused(node, f"{path} is '{name}', but this scene is no file; give g and tau")
    file = Path(os.path.realpath(folder / name))  # links may not lead out either
    if not file.is_relative_to(os.path.realpath(folder)):
        raise refused(node, f"{path} is '{name}'; it must lie in the folder of the scene")
    with placed_at(node):
        return parse_prony(read_text(file), file.name)
