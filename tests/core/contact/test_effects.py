"""Effects: absent unless requested, stable together, refused in one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar_core.common.array_table import flat, gathered
from avatar_core.contact import step as kernels
from avatar_core.contact.effects import (
    EFFECTS,
    Effect,
    Friction,
    Inertia,
    Respiration,
    SelfWeight,
    Viscoelasticity,
)
from avatar_core.contact.layout import MODEL, lay_out
from avatar_core.contact.tool_path import inner_positions
from avatar_core.errors import SceneError
from avatar_core.geometry.tip import Jaw, Tip
from avatar_core.vademecum.model import Vademecum
from tests.helpers.contact import data_of, prepare, step
from tests.helpers.tool_motion import AWAY

RADIUS = 10e-3
SPHERE, PATCH = Tip("sphere", RADIUS), Tip("patch", RADIUS)
GRASPER = replace(SPHERE, grasp=Jaw())
# these effects have their own tests: they need another organ, or another tip
OWN = ("large_deformation", "tumour", "tilt")
CHOICES: dict[str, Effect] = {
    name: kind.example() for name, kind in EFFECTS.items() if name not in OWN
}
CHOICES |= {
    effect.name: effect
    for effect in (Viscoelasticity((0.3, 0.2), (0.05, 1.0)), SelfWeight(), Respiration(period=0.5))
}


@pytest.mark.parametrize("name", CHOICES)
def test_an_effect_is_absent_from_the_step_when_off(
    phantom_vademecum: Vademecum, name: str
) -> None:
    """The model then holds None, no array."""
    without = lay_out(phantom_vademecum, (PATCH,), effects=())
    tip = GRASPER if name == "grasp" else PATCH
    with_it = lay_out(phantom_vademecum, (tip,), effects=(CHOICES[name],))
    given, more = data_of(without).state, data_of(with_it).state
    assert all(getattr(given, each, None) is None for each in ("superposition", *EFFECTS))
    assert EFFECTS[name].State is None or getattr(more, name) is not None
    assert not [key for key in flat(without) if "." in key]
    brought = {"friction"} if name == "grasp" else set()  # its solver has forces of any direction
    assert [key for key in flat(with_it) if key.startswith(f"{name}.")]
    assert all(getattr(with_it, other) is None for other in CHOICES.keys() - {name} - brought)


def test_all_scenes_share_one_compiled_step(phantom_vademecum: Vademecum) -> None:
    for tip, effects in ((PATCH, ()), (SPHERE, ()), (GRASPER, tuple(CHOICES.values()))):
        prepare(phantom_vademecum, (tip,), effects=effects)
    for kernel in (kernels.contact_solve, kernels.contact_deform, kernels.force_error):
        assert len(kernel.signatures) == 1


def test_a_layout_survives_being_flat(phantom_vademecum: Vademecum) -> None:
    for effects in ((), tuple(CHOICES.values())):
        arrays = flat(lay_out(phantom_vademecum, (GRASPER,), effects=effects))
        again = flat(gathered(MODEL, arrays))
        assert again.keys() == arrays.keys()
        assert all(again[name] is array for name, array in arrays.items())


@pytest.mark.long
def test_everything_at_once_stays_sane(phantom_vademecum: Vademecum) -> None:
    """Two graspers, all effects, ten seconds of contact: finite, bounded, at rest in the end."""
    v = phantom_vademecum
    data = prepare(v, (GRASPER,) * 2, cloud="surface", effects=tuple(CHOICES.values()))
    rng = np.random.default_rng(0)
    peak, held = 0.0, np.zeros(2, bool)
    for _ in range(10):
        pair = rng.choice(inner_positions(v), 2, replace=False)
        for k in range(500):
            depth = 6e-3 * np.sin(np.pi * k / 500) ** 2 - 1e-3
            drag = 3e-3 * np.sin(4 * np.pi * k / 500)
            data.state.jaw[:] = 50 < k < 200, 300 < k < 450
            held = held | data.state.grasp.held
            centers, normals = v.surface.centers[pair], v.surface.normals[pair]
            step(data, centers + (RADIUS - depth) * normals + drag * np.roll(normals, 1, axis=1))
            assert np.isfinite(data.out.force).all()
            assert np.isfinite(data.out.cloud).all()
            peak = max(peak, float(np.abs(data.out.force).max()))
    assert 0.5 < peak < 100.0 and held.all()
    for _ in range(20_000):
        step(data, np.array([AWAY, AWAY]))
    memory = data.state.viscoelasticity
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
    """More such numbers, in files: tests/core/scene/test_scene_file.py."""
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
