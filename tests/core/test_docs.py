"""The README and the pages of msg_docs: links, headings, length, HTML."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import pytest
import typer

import avatar_core as av
from avatar_core.cli.main import app
from tests.core.test_prose import INVERTED
from tests.helpers.paths import ROOT

README, DOCS = ROOT / "README.md", ROOT / "msg_docs"
PAGES = sorted(page for page in DOCS.rglob("*.md") if page.name != "index.md")  # Sphinx

README_LINES, WORDS = 110, 15_000  # of all pages together, tables included, code not
LONGEST = 35  # words of a sentence


def prose(page: Path) -> str:
    """Return a page without its blocks of code."""
    return re.sub(r"^[ ]*```.*?^[ ]*```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def headings(page: Path) -> list[tuple[int, str]]:
    """Return level and text of each heading."""
    return [(len(a), b) for a, b in re.findall(r"^(#+) (.+)$", prose(page), re.MULTILINE)]


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives to the headings of a page."""
    kept = (re.sub(r"[^\w\- ]", "", text).strip() for _, text in headings(page))
    return {text.lower().replace(" ", "-") for text in kept}


def links(page: Path) -> list[tuple[Path, str]]:
    """Return file and anchor of each link inside the repository."""
    found = re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)\)", prose(page))
    return [((page.parent / path).resolve() if path else page, anchor) for path, anchor in found]


@pytest.mark.parametrize("page", [README, *PAGES], ids=lambda page: page.name)
def test_every_link_leads_somewhere(page: Path) -> None:
    for target, anchor in links(page):
        assert target.exists(), target
        assert not anchor or anchor in anchors(target), (target, anchor)


@pytest.mark.parametrize("page", [README, *PAGES], ids=lambda page: page.name)
def test_headings_descend_one_level_at_a_time(page: Path) -> None:
    levels = [level for level, _ in headings(page)]
    assert levels[0] == 1 and levels.count(1) == 1
    assert all(after - before <= 1 for before, after in pairwise(levels))


def test_every_page_can_be_reached_from_the_readme() -> None:
    reached, ahead = set(), [README]
    while ahead:
        page = ahead.pop()
        if page.suffix == ".md" and page not in reached:
            reached.add(page)
            ahead += [target for target, _ in links(page)]
    assert not set(PAGES) - reached


def test_the_pages_become_html_without_a_warning(tmp_path: Path) -> None:
    """Links, anchors, pictures and the docstrings of the public names."""
    for module in ("sphinx", "myst_parser", "furo", "sphinxcontrib.mermaid"):
        pytest.importorskip(module)
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", str(DOCS), str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    first = (tmp_path / "index.html").read_text()
    for page in PAGES:
        html = page.relative_to(DOCS).with_suffix(".html").as_posix()
        assert (tmp_path / html).exists() and f'href="{html}"' in first, html
    api = (tmp_path / "interfaces" / "python.html").read_text()
    for package in (av, av.mor, av.shapes, av.effects, av.uncertainty):
        for name in package.__all__:
            found = getattr(package, name)
            if not isinstance(found, ModuleType):
                assert f'id="{package.__name__}.{name}"' in api, name


def command_lines(page: Path) -> list[str]:
    """Return the arguments of each ``avatar`` command in blocks of shell code and in spans."""
    blocks = re.findall(r"^```sh\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    lines += re.findall(r"`(avatar [a-z][^`\n]*)`", page.read_text())
    found = (re.search(r"(?:^|/)avatar (.*)$", line.split("#")[0].strip()) for line in lines)
    return [match[1] for match in found if match]


@pytest.mark.parametrize("page", [README, *PAGES], ids=lambda page: page.name)
def test_commands_and_options_exist(page: Path) -> None:
    for line in command_lines(page):
        words, command = shlex.split(line), typer.main.get_command(app)
        while words and hasattr(command, "commands"):
            command = command.commands[words.pop(0)]
        given = {word.split("=")[0] for word in words if re.match("-[^0-9]", word)}
        assert given <= {name for each in command.params for name in each.opts}, line


def sentences(page: Path) -> list[str]:
    """Return the sentences of paragraphs and lists, not of tables, headings and pictures."""
    text = re.sub(r"<!--.*?-->", "", prose(page), flags=re.DOTALL)
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`", "code", text)
    blocks = re.split(r"\n\s*\n|\n\s*(?:[-*>]|\d+\.) ", text)
    kept = (block for block in blocks if "|" not in block and not block.lstrip().startswith("#"))
    return [part for block in kept for part in re.split(r"[.:!?]\s", " ".join(block.split()))]


@pytest.mark.parametrize("page", [README, *PAGES], ids=lambda page: page.name)
def test_sentences_are_short(page: Path) -> None:
    assert not [sentence for sentence in sentences(page) if len(sentence.split()) > LONGEST]


@pytest.mark.parametrize("page", [README, *PAGES], ids=lambda page: page.name)
def test_sentences_begin_with_their_subject(page: Path) -> None:
    assert not [sentence for sentence in sentences(page) if INVERTED.match(sentence)]


def test_the_readme_can_be_read_in_one_go() -> None:
    assert len(README.read_text().splitlines()) <= README_LINES


def test_the_pages_can_be_read_in_an_hour() -> None:
    words = (word for page in PAGES for word in prose(page).split())
    assert sum(any(map(str.isalnum, word)) for word in words) <= WORDS  # a "|" is none
