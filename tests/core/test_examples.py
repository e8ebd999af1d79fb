"""Examples in the docstrings of all public names, run as they stand there."""

from __future__ import annotations

import doctest
import inspect
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
import scipy.sparse as sp

import avatar_core as av
from avatar_core.atlas.growth import AtlasOptions
from avatar_core.atlas.response import ResponseSolver
from avatar_core.atlas.workers import Workers
from avatar_core.contact.tool_path import middle_of_access, starts_apart
from tests.helpers.disk_cache import cached_on_disk

ROUGH = av.shapes.TemplateRule(
    n_stages=3, last_sweeps=0, n_samples=400, largest_mean=4e-3, largest_reverse_mean=8e-3
)


def public() -> dict[str, Any]:
    """All public names but the packages that hold some of them."""
    rooms = {"av": av, **{room: getattr(av, room) for room in ("effects", "mor", "shapes")}}
    rooms["uncertainty"] = av.uncertainty
    found = {
        f"{room}.{name}": getattr(of, name) for room, of in rooms.items() for name in of.__all__
    }
    return {n: o for n, o in found.items() if inspect.isclass(o) or inspect.isfunction(o)}


@cached_on_disk
def organ() -> av.Vademecum:
    """A small vademecum with a coordinate."""
    options = av.OrganOptions(
        n_vertices=400,
        n_displayed=0,
        n_certified=8,
        rule=av.BuildRule(max_modes=30),
        coordinates=(av.Coordinate("poisson", 0.40, 0.48),),
    )
    return av.build(av.phantom_liver(12e-3), options)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The names and files of which the examples make use."""
    folder = tmp_path_factory.mktemp("examples")
    v, liver = organ(), av.phantom_liver(12e-3)
    av.save(v, folder / "liver.h5")
    meshio.write(folder / "liver.stl", meshio.Mesh(liver.vertices, [("triangle", liver.faces)]))
    template = av.shapes.Template.of(liver, 300)
    options = AtlasOptions(spacing=0.02, rule=ROUGH)
    solver, alone = ResponseSolver(rank=40), Workers(jobs=1)
    larger = replace(liver, vertices=1.05 * liver.vertices, name="larger")
    given: dict[str, Any] = {"template": template, "workers": alone, "solve_response": solver}
    grown = av.create_atlas(folder / "base", [liver, larger], options, **given)
    rng, place = np.random.default_rng(0), middle_of_access(v)
    point, normal = v.surface.centers[place], v.surface.normals[place]
    return {
        "av": av,
        "np": np,
        "folder": folder,
        "v": v,
        "liver": liver,
        "larger": larger,
        "point": point,
        "normal": normal,
        "outside": point + 0.1 * normal,
        "places": starts_apart(v, 4),
        "model": av.prepare(v, av.Scene(effects=())),
        "K": sp.diags([-np.ones(39), 2.1 * np.ones(40), -np.ones(39)], [-1, 0, 1]).tocsr(),
        "F": rng.standard_normal((40, 12)),
        "rough": ROUGH,
        "template": template,
        "rough_options": options,
        "solver": solver,
        "alone": alone,
        "atlas": grown.atlas,
    }


@pytest.fixture
def inside(world: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(world["folder"])
    yield world["folder"]


@pytest.mark.parametrize("name", public())
def test_every_public_name_has_an_example_that_runs(
    name: str, world: dict[str, Any], inside: Path
) -> None:
    found = inspect.unwrap(public()[name])
    text = inspect.cleandoc(found.__doc__ or "")
    assert "\nExamples\n--------\n" in text, "no example"
    example = doctest.DocTestParser().get_doctest(text, dict(world), name, None, 0)
    assert example.examples
    assert not any(doctest.SKIP in one.options for one in example.examples)
    said: list[str] = []
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    with np.printoptions(legacy="1.25"):
        doctest.DocTestRunner(optionflags=flags).run(example, out=said.append)
    assert not said, "".join(said)
