"""Prony terms from a file of two columns: g, tau [s]."""

from __future__ import annotations

import math
from dataclasses import fields

from avatar_core.common.quantities import Quantity, lies_in
from avatar_core.contact.effects import Viscoelasticity
from avatar_core.errors import SceneError


def parse_prony(text: str, source: str) -> dict[str, tuple[float, ...]]:
    """Return ``g`` and ``tau`` of comma-separated text; empty lines, and text after #, are ignored.

    A header must read ``g, tau``, so that exchanged columns are noticed.

    Raises
    ------
    SceneError
        Naming source and line.
    """
    rows: list[list[float]] = []
    header_may_come = True
    for number, line in enumerate(text.splitlines(), start=1):
        cells = [cell.strip() for cell in line.partition("#")[0].split(",")]
        if not any(cells):
            continue
        if not (header_may_come and _is_header(cells)):
            rows.append(_row(cells, f"{source}:{number}"))
        header_may_come = False
    if not rows:
        raise SceneError(f"{source}:1: holds no term; write one 'g, tau' a line")
    g, tau = zip(*rows, strict=True)
    return {"g": g, "tau": tau}


def _is_header(cells: list[str]) -> bool:
    """Return whether cells are the header; units may follow the words, e.g. ``g [-], tau [s]``."""
    return [cell.partition(" ")[0].lower() for cell in cells] == ["g", "tau"]


def _row(cells: list[str], place: str) -> list[float]:
    if len(cells) != 2:
        raise SceneError(f"{place}: {len(cells)} columns; give two, g and tau")
    return [
        _number(cell, place, field.name, field.metadata["quantity"])
        for cell, field in zip(cells, fields(Viscoelasticity), strict=True)
    ]


def _number(cell: str, place: str, key: str, allowed: Quantity) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not lies_in(value, allowed):
        raise SceneError(
            f"{place}: {key} is '{cell[:40]}'; it must be a number in {allowed} (columns: g, tau)"
        )
    return value
