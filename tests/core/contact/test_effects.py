"""Effects: absent where nobody asks for them, sane together, refused in one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar_core.contact import kernels
from avatar_core.contact.effects import (
    EFFECTS,
    Effect,
    Friction,
    Inertia,
    Respiration,
    SelfWeight,
    SeveralTools,
    Viscoelasticity,
)
from avatar_core.contact.layout import Layout, lay_out
from avatar_core.contact.model import _effects, prepare, step
from avatar_core.contact.tool_path import inner_positions
from avatar_core.errors import SceneError
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.model import Vademecum
from tests.helpers.tool_motion import AWAY

RADIUS = 10e-3
SPHERE, PATCH = Tip("sphere", RADIUS), Tip("patch", RADIUS)
CHOICES: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        SeveralTools(),
        Friction(),
        Viscoelasticity((0.3, 0.2), (0.05, 1.0)),
        Inertia(),
        SelfWeight(),
        Respiration(period=0.5),
    )
}


@pytest.mark.parametrize("name", CHOICES)
def test_an_effect_is_absent_from_the_step_when_off(
    phantom_vademecum: Vademecum, name: str
) -> None:
    """No array in the model: only None."""
    without = lay_out(phantom_vademecum, (PATCH,), effects=())
    with_it = lay_out(phantom_vademecum, (PATCH,), effects=(CHOICES[name],))
    given, more = _effects(without), _effects(with_it)
    assert all(value is None for value in given)
    assert getattr(more, name) is not None
    assert not [key for key in without.flat() if "." in key]
    assert [key for key in with_it.flat() if key.startswith(f"{name}.")]
    assert all(getattr(more, other) is None for other in CHOICES if other != name)


def test_all_scenes_share_one_compiled_step(phantom_vademecum: Vademecum) -> None:
    for tip, effects in ((PATCH, ()), (SPHERE, ()), (SPHERE, tuple(CHOICES.values()))):
        prepare(phantom_vademecum, (tip,), effects=effects)
    for kernel in (kernels.contact_solve, kernels.contact_deform, kernels.force_error):
        assert len(kernel.signatures) == 1


def test_the_list_of_effects_is_complete() -> None:
    assert set(CHOICES) | {"large_deformation", "tumour", "tilt"} == set(EFFECTS)


def test_a_layout_survives_being_flat(phantom_vademecum: Vademecum) -> None:
    layout = lay_out(phantom_vademecum, (SPHERE,), effects=tuple(CHOICES.values()))
    again = Layout.of(layout.flat())
    for a, b in zip(layout.effects, again.effects, strict=True):
        assert (a is None) == (b is None)
        assert a is None or all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.long
def test_everything_at_once_stays_sane(phantom_vademecum: Vademecum) -> None:
    """Two tools, all effects, ten seconds of touching: finite, bounded, and at rest in the end."""
    v = phantom_vademecum
    model = prepare(v, (SPHERE,) * 2, cloud="surface", effects=tuple(CHOICES.values()))
    rng = np.random.default_rng(0)
    peak = 0.0
    for _ in range(10):
        pair = rng.choice(inner_positions(v), 2, replace=False)
        for k in range(500):
            depth = 6e-3 * np.sin(np.pi * k / 500) ** 2 - 1e-3
            drag = 3e-3 * np.sin(4 * np.pi * k / 500)
            centers, normals = v.surface.centers[pair], v.surface.normals[pair]
            step(model, centers + (RADIUS - depth) * normals + drag * np.roll(normals, 1, axis=1))
            assert np.isfinite(model.out.force).all()
            assert np.isfinite(model.out.cloud).all()
            peak = max(peak, float(np.abs(model.out.force).max()))
    assert 0.5 < peak < 100.0
    for _ in range(20_000):
        step(model, np.array([AWAY, AWAY]))
    memory = model.effects.viscoelasticity
    assert np.abs(memory.past).max() < 1e-3 * peak
    assert np.abs(memory.near_elastic[: memory.count[0]]).max(initial=0.0) < 1e-3


# --- Refused --------------------------------------------------------------------------------------


def test_two_tools_without_the_effect_are_refused(phantom_vademecum: Vademecum) -> None:
    with pytest.raises(SceneError, match="2 tools without several_tools"):
        prepare(phantom_vademecum, (SPHERE,) * 2, effects=())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Friction(-0.1, -0.2), "friction.static is -0.1; it must lie in 0 to 1"),
        (lambda: Viscoelasticity((0.3,), (0.0,)), "viscoelasticity.tau is 0.0; it must lie"),
        (lambda: Inertia(density=0.0), "inertia.density is 0.0"),
        (lambda: SelfWeight(direction=(0.0, 0.0, 0.0)), "not all zero"),
        (lambda: Respiration(period=float("nan")), "respiration.period is nan"),
    ],
)
def test_numbers_out_of_range_are_refused_in_one_line(make, message: str) -> None:  # type: ignore[no-untyped-def]
    """More of them, in files: tests/core/scene/test_scene_file.py."""
    with pytest.raises(SceneError) as refusal:
        make()
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("effect", [SelfWeight(), Inertia()])
def test_a_vademecum_without_the_organs_mass_says_what_builds_one(
    phantom_vademecum: Vademecum, effect: Effect
) -> None:
    with pytest.raises(SceneError, match="avatar vademecum"):
        prepare(replace(phantom_vademecum, body=None), (SPHERE,), effects=(effect,))
