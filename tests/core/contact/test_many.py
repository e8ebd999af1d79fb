"""Many loops in one call: bit for bit those of the step, whatever the threads do."""

from __future__ import annotations

import numpy as np
import pytest

import avatar_core as av
from avatar_core.common.array_table import flat
from avatar_core.contact import many
from avatar_core.vademecum.model import Vademecum

K = 70


def scene(name: str) -> av.Scene:
    of = av.effects
    if name == "two jaws that turn":
        tools = tuple(
            av.Tool(side, av.Tip("sphere", 4e-3, grasp=av.Jaw(radius=3e-3))) for side in ("a", "b")
        )
        return av.Scene(tools=tools, effects=(of.SeveralTools(), of.Friction()))
    if name == "history":
        return av.Scene(effects=(of.Viscoelasticity.example(), of.Friction()))
    return av.Scene(effects=())


@pytest.mark.parametrize("name", ["bare", "history", "two jaws that turn"])
def test_loops_end_in_the_state_that_the_step_leaves(
    phantom_vademecum: Vademecum, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(many, "n_cores", lambda: 3)
    v, rng = phantom_vademecum, np.random.default_rng(0)
    model = av.prepare(v, scene(name))
    together, alone = ([model.data() for _ in range(K)] for _ in range(2))
    chosen = rng.integers(0, v.surface.n_positions, (K, model.n_tools))
    centers, normals = v.surface.centers[chosen], v.surface.normals[chosen]
    turns = rng.standard_normal((K, model.n_tools, 4))
    turns /= np.linalg.norm(turns, axis=2, keepdims=True)
    jaws = rng.random((K, model.n_tools)) < 0.5 if "jaws" in name else None
    seen = set()
    for depth in np.linspace(-4e-3, 3e-3, 25):
        tips = centers + (5e-3 - depth) * normals
        status = av.step_many(model, together, tips, turns, jaws if depth > 1e-3 else None)
        for i, data in enumerate(alone):
            closed = None if jaws is None or depth <= 1e-3 else jaws[i]
            assert av.step(model, data, tips[i], turns[i], closed) == status[i]
        seen |= set(status.tolist())
    assert av.Status.OK in seen
    for one, other in zip(together, alone, strict=True):
        there = flat(other.state)
        for key, array in flat(one.state).items():
            np.testing.assert_array_equal(array, there[key], err_msg=key)


def test_one_tool_needs_no_axis_of_tools_and_no_loop_is_no_error(
    phantom_vademecum: Vademecum,
) -> None:
    model = av.prepare(phantom_vademecum, av.Scene(effects=()))
    datas = [model.data() for _ in range(3)]
    point = phantom_vademecum.surface.centers[7]
    status = av.step_many(model, datas, np.tile(point + np.array([0.0, 0.3, 0.0]), (3, 1)))
    assert status.tolist() == [0, 0, 0]
    assert av.step_many(model, [], np.empty((0, 1, 3))).shape == (0,)


def test_bad_batches_are_refused_in_a_line(phantom_vademecum: Vademecum) -> None:
    model = av.prepare(phantom_vademecum, av.Scene(effects=()))
    datas = [model.data() for _ in range(2)]
    tips = np.zeros((2, 1, 3))
    with pytest.raises(av.AvatarError, match="given twice"):
        av.step_many(model, [datas[0], datas[0]], tips)
    other = av.prepare(phantom_vademecum, av.Scene(effects=()))
    with pytest.raises(av.AvatarError, match="another model"):
        av.step_many(other, datas, tips)
    for wrong in (tips[:1], np.zeros((2, 2, 3)), np.zeros(6)):
        with pytest.raises(av.AvatarError, match=r"tips of shape .*; give \(2, 1, 3\)"):
            av.step_many(model, datas, wrong)
    with pytest.raises(av.AvatarError, match="jaws of shape"):
        av.step_many(model, datas, tips, jaws=np.zeros(3, bool))
