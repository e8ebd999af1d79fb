"""Docstrings and comments begin each sentence with its subject."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.paths import ROOT

FOLDERS = ("avatar_core", "avatar_ros", "tests")
INVERTED = re.compile(r"(Of|What|That which|The same of)\b[^?]*$")  # questions may begin so
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def sentences(source: str) -> Iterator[str]:
    """Yield the sentences of all docstrings and comments."""
    texts = [ast.get_docstring(n) for n in ast.walk(ast.parse(source)) if isinstance(n, DOCUMENTED)]
    texts += re.findall(r"(?:^ *|  )# (?:-+ )?(.+)$", source, re.MULTILINE)
    for text in texts:
        yield from re.split(r"(?<=[.?!:])\s+|\n\s*\n", text or "")


def inverted(source: str) -> list[str]:
    return [text for text in sentences(source) if INVERTED.match(text.strip())]


@pytest.mark.parametrize("folder", FOLDERS)
def test_no_sentence_is_inverted(folder: str) -> None:
    files = sorted(Path(ROOT, folder).rglob("*.py"))
    found = {str(file.relative_to(ROOT)): inverted(file.read_text()) for file in files}
    assert {name: texts for name, texts in found.items() if texts} == {}


@pytest.mark.parametrize("text", ["Of a tip [m].", "A tip. What it bears.", "The same of a cone."])
def test_inverted_sentences_are_found(text: str) -> None:
    assert inverted(f'"""{text}"""\n') and inverted(f"x = 1  # {text}\n")
    assert not inverted('"""What is this?"""\n# A part of what\n# follows\n')
