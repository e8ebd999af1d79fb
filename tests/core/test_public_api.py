"""The public API: imports of a notebook, and the lines of the README, run as they stand."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import avatar_core as av
from avatar_core.vademecum.model import Vademecum
from tests.helpers.page_code import code_of, run
from tests.helpers.paths import ROOT

README = ROOT / "README.md"


def test_names_for_type_checkers_are_the_names_that_exist() -> None:
    tree = ast.parse(Path(av.__file__).read_text())
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    named = {a.asname or a.name for node in ast.walk(block) for a in getattr(node, "names", ())}
    assert named == set(av.__all__) == {n for n in dir(av) if getattr(av, n, None) and n in named}


def test_nothing_heavy_is_imported_before_it_is_asked_for() -> None:
    code = (
        "import sys, avatar_core as av; before = set(sys.modules); assert 'effects' in dir(av);"
        "print(*sorted(m.partition('.')[0] for m in before))"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert not {"numpy", "scipy", "numba", "h5py", "skfem", "igl"} & set(done.stdout.split())


def test_every_effect_of_a_scene_is_there() -> None:
    for effect in av.effects.EFFECTS.values():
        assert getattr(av.effects, effect.__name__) is effect
    scene = av.Scene(effects=(av.effects.Friction(static=0.2, kinetic=0.1),))
    assert scene.effect("friction") == av.effects.Friction(0.2, 0.1)


@pytest.mark.parametrize("name", av.__all__)
def test_everything_public_is_documented(name: str) -> None:
    found = getattr(av, name)
    assert len((found.__doc__ or "").split()) >= 5
    if callable(found) and not isinstance(found, type):
        assert found.__annotations__.get("return") is not None


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'vademecum_of'"):
        av.vademecum_of  # noqa: B018


def test_a_budget_chooses_what_is_shown_and_leaves_the_force(phantom_vademecum: Vademecum) -> None:
    """The tolerance of a coarser point of the certified curve: fewer modes, the same force.

    Each mode counts as a microsecond, so that the machine's load does not matter.
    """
    certificate = phantom_vademecum.certificate
    assert certificate is not None and certificate.curve is not None
    points = tuple(
        replace(p, p50=1e-6 * p.detail.modes, p99=1e-6 * p.detail.modes)
        for p in certificate.curve.of("surface").points
    )
    curve = replace(certificate.curve, points=points)
    vademecum = phantom_vademecum.with_certificate(replace(certificate, curve=curve))
    scene = av.Scene(effects=())
    loose = float(np.median([point.l2 for point in points]))
    coarse = av.prepare(vademecum, scene, av.Budget(tolerance=loose, deadline=np.inf))
    fine = av.prepare(vademecum, scene)
    assert coarse.n_modes < fine.n_modes
    forces = [press(model, vademecum) for model in (coarse, fine)]
    np.testing.assert_allclose(forces[0], forces[1], rtol=1e-6)
    with pytest.raises(av.AvatarError, match="nearest"):
        av.prepare(vademecum, scene, av.Budget(tolerance=1e-9, deadline=np.inf))


def press(model: av.ContactModel, vademecum: Vademecum) -> Sequence[float]:
    point, normal = vademecum.surface.centers[100], vademecum.surface.normals[100]
    data = model.data()
    for depth in np.linspace(-5e-3, 2e-3, 50):
        av.step(model, data, point + (5e-3 - depth) * normal)
    return list(data.out.force[0])


@pytest.mark.long
def test_the_lines_of_the_readme_give_the_numbers_beside_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each ``# -> number`` equals the output of its line, to 2 %."""

    promised = [float(number) for number in re.findall(r"# -> (-?[\d.e-]+)", code_of(README))]
    run(README, tmp_path, monkeypatch)
    printed = [float(line) for line in capsys.readouterr().out.split()]
    assert len(promised) >= 2
    np.testing.assert_allclose(printed, promised, rtol=0.02)
