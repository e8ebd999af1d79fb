"""Conversion of values to JSON, and of JSON of unknown origin to dataclasses, checked by field.

The inverse of ``json.dumps(dataclasses.asdict(...))``. msgspec.convert is faster (0.3 ms instead of
9 ms for the largest attribute). But msgspec, like pydantic, ignores fields that a plain dataclass
does not have. Unknown fields are how a newer file is recognised here.
"""

from __future__ import annotations

import json
import math
import types
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from avatar_core.errors import StorageError

Kind = TypeVar("Kind")

MAX_LETTERS = 4 << 20  # letters of JSON; the curve of a large vademecum has 50,000
MAX_NAME = 200  # letters of a name


def plain(value: Any) -> Any:
    """Convert a value for JSON: arrays become lists, numbers plain, and non-finite numbers null."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):  # an array or number of numpy
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def parsed(text: str, key: str) -> Any:
    """Return the value of JSON text.

    Raises
    ------
    StorageError
        If it is too long, nested too deep or no JSON.
    """
    if len(text) > MAX_LETTERS:
        raise StorageError(f"'{key}' has {len(text)} letters; build the file again")
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise StorageError(f"'{key}' cannot be understood; build the file again") from error


def of_plain(kind: type[Kind], value: Any, key: str) -> Kind:
    """Return a value of a type: a number, text, tuple, Literal, Enum, union or dataclass of these.

    Parameters
    ----------
    value : Any
        Value as JSON gives it.
    key : str
        Place of the value, for errors.

    Raises
    ------
    StorageError
        If a field is missing, unknown or of another type; the message names it.
    AvatarError
        Raised by the dataclass for values out of range.
    """
    if is_dataclass(kind):
        return _instance(kind, value, key)
    made: Kind = _value(kind, value, key)
    return made


def require_name(name: Any, key: str) -> str:
    """Return the name, if it is one line of printable text; StorageError otherwise."""
    if not isinstance(name, str) or not name.isprintable() or len(name) > MAX_NAME:
        raise StorageError(
            f"'{key}' is no name of at most {MAX_NAME} printable letters; build the file again"
        )
    return name


def _instance(kind: Any, value: Any, key: str) -> Any:
    if not isinstance(value, dict):
        raise _other(key, "named values", value)
    hints = get_type_hints(kind)
    own = {field.name: field for field in fields(kind) if field.init}
    unknown = sorted(set(value) - set(own))
    if unknown:
        raise StorageError(f"'{key}' has an unknown value '{unknown[0][:40]}'; upgrade avatar")
    for name, field in own.items():
        optional = field.default is not MISSING or field.default_factory is not MISSING
        if name not in value and not optional:
            raise StorageError(f"'{key}.{name}' is missing; build the file again")
    return kind(**{name: of_plain(hints[name], v, f"{key}.{name}") for name, v in value.items()})


def _value(kind: Any, value: Any, key: str) -> Any:
    origin = get_origin(kind)
    if origin is Literal:
        if value not in get_args(kind):
            raise _other(key, f"one of {', '.join(map(str, get_args(kind)))}", value)
        return value
    if origin in (Union, types.UnionType):
        if value is None and type(None) in get_args(kind):
            return None
        (rest,) = (one for one in get_args(kind) if one is not type(None))
        return of_plain(rest, value, key)
    if origin is tuple:
        return _tuple(get_args(kind), value, key)
    if origin is dict:
        return {
            name: of_plain(get_args(kind)[1], one, f"{key}.{name}") for name, one in value.items()
        }
    if isinstance(kind, type) and issubclass(kind, Enum):
        try:
            return kind(value)
        except ValueError as error:
            raise _other(key, f"one of {', '.join(one.value for one in kind)}", value) from error
    if kind is float and type(value) is int and abs(value) < 2**53:
        return float(value)
    if type(value) is not kind:  # a truth value is no number
        raise _other(key, {float: "a number", int: "a whole number"}.get(kind, "text"), value)
    if kind is int and abs(value) >= 2**53:
        raise _other(key, "a number", value)
    return value


def _tuple(kinds: tuple[Any, ...], value: Any, key: str) -> tuple[Any, ...]:
    if not isinstance(value, list):
        raise _other(key, "a list", value)
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(kinds) != len(value):
        raise _other(key, f"{len(kinds)} values", value)
    return tuple(
        of_plain(kind, one, f"{key}[{k}]")
        for k, (kind, one) in enumerate(zip(kinds, value, strict=True))
    )


def _other(key: str, wanted: str, value: Any) -> StorageError:
    shown = " ".join(str(value)[:40].split())
    return StorageError(f"'{key}' is {shown!r}, not {wanted}; build the file again")
