"""The bare step of a scene gives what the step fused by hand gives."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from avatar_core.contact.model import prepare, step
from avatar_core.contact.tool_path import slide
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.tip import Tip
from avatar_core.offline.pipeline import OrganOptions, build
from avatar_core.studies.bench.fused import fused_ratio, module_of
from avatar_core.vademecum.model import Vademecum

TIP = 10e-3
PATCH = Tip("patch", TIP)


@pytest.fixture(scope="module")
def fused() -> ModuleType:
    return module_of(Path(__file__).with_name("fused_step.py"))


@pytest.fixture(scope="module")
def organ() -> Vademecum:
    return build(phantom_liver(12e-3), OrganOptions(n_vertices=800, n_certified=3))


@pytest.mark.long
def test_the_bare_step_agrees_with_the_one_fused_by_hand(
    fused: ModuleType, organ: Vademecum
) -> None:
    """To 1e-12 on and off the surface, past the rim of access, in the depth and far away."""
    bare = prepare(organ, (PATCH,), cloud="volume", effects=())
    other = prepare(organ, (PATCH,), cloud="volume", effects=())
    path = slide(organ, TIP, 5e-3, 60e-3, step=5e-4)
    rng = np.random.default_rng(0)
    low, high = organ.mesh.vertices.min(axis=0), organ.mesh.vertices.max(axis=0)
    leaps = rng.uniform(low - 0.02, high + 0.02, (300, 3))
    back = np.repeat(path[len(path) // 2][None], 2, axis=0)  # before and after a broken pose
    path = np.concatenate([path, leaps, back[:1], [[np.nan, 0, 0]], back[1:], leaps[:20]])
    touched = 0
    for tip in path:
        status = step(bare, tip[None])
        assert fused.fused_step(*other.tables[:4], tip[None].copy()) == status
        scale = max(1.0, np.abs(bare.out.force).max())
        np.testing.assert_allclose(other.out.force, bare.out.force, rtol=0, atol=1e-12 * scale)
        np.testing.assert_allclose(other.out.cloud, bare.out.cloud, rtol=0, atol=1e-12)
        assert other.out.n_contacts[0] == bare.out.n_contacts[0]
        touched += int(bare.out.n_contacts[0])
    assert 100 < touched < len(path)


@pytest.mark.long
def test_both_work_on_the_same_arrays_in_turn(fused: ModuleType, organ: Vademecum) -> None:
    """As the benchmark has them do, over borders of regions too."""
    bare = prepare(organ, (PATCH,), cloud="volume", effects=())
    path = slide(organ, TIP, 5e-3, 60e-3, step=1e-4)[:, None]
    assert fused_ratio(bare, fused.fused_step, np.ascontiguousarray(path)) > 0.0
