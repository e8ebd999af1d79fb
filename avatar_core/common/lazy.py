"""Public names of a package that are imported when they are first asked for."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy(
    package: str, origin: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a package (PEP 562).

    Parameters
    ----------
    package : str
        ``__name__`` of the package.
    origin : mapping of str to str
        Module of each public name, as "contact.model". "contact.model:step" gives another name of
        that module, and "contact.effects:" the module itself.
    """
    root = package.partition(".")[0]

    def found(name: str) -> Any:
        if name not in origin:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        path, separator, own = origin[name].partition(":")
        module = import_module(f"{root}.{path}")
        value = module if separator and not own else getattr(module, own or name)
        vars(sys.modules[package])[name] = value  # also where a module of this name was imported
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *origin})

    return found, names
