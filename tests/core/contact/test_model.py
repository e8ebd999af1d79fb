"""A model is constant, and serves several loops at once."""

from __future__ import annotations

from threading import Thread

import numpy as np
import pytest

from avatar_core.common.array_table import flat
from avatar_core.contact.effects import Friction, Inertia, Viscoelasticity
from avatar_core.contact.model import ContactData, ContactModel, model_of, step
from avatar_core.contact.tool_path import push_and_slide, starts_apart
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.model import Vademecum

RADIUS, N = 5e-3, 600
EFFECTS = (Friction(), Viscoelasticity((0.3,), (0.1,)), Inertia())


@pytest.fixture(scope="module")
def paths(phantom_vademecum: Vademecum) -> list[np.ndarray]:
    """Return the paths of two distant tools, each of shape (n, 1, 3)."""
    starts = starts_apart(phantom_vademecum, 2)
    made = (push_and_slide(phantom_vademecum, RADIUS, 5e-3, 3e-3, N, at) for at in starts)
    return [path[:, None] for path in made]


@pytest.fixture(scope="module")
def model(phantom_vademecum: Vademecum) -> ContactModel:
    return model_of(phantom_vademecum, (Tip("sphere", RADIUS),), effects=EFFECTS)


def follow(data: ContactData, path: np.ndarray) -> np.ndarray:
    """Return the forces along a path, and the last cloud, in one row."""
    force = np.empty(path.shape)
    for k, tips in enumerate(path):
        step(data.model, data, tips)
        force[k] = data.out.force
    return np.concatenate([force.ravel(), data.out.cloud.ravel()])


def test_two_loops_of_a_model_feel_what_each_feels_alone(
    model: ContactModel, paths: list[np.ndarray]
) -> None:
    before = {name: values.copy() for name, values in flat(model.arrays).items()}
    alone = [follow(model.data(), path) for path in paths]
    found: dict[int, np.ndarray] = {}

    def loop(k: int, data: ContactData) -> None:
        found[k] = follow(data, paths[k])

    threads = [Thread(target=loop, args=(k, model.data())) for k in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for k, expected in enumerate(alone):
        assert np.abs(expected).max() > 0.1
        np.testing.assert_array_equal(found[k], expected)
    for name, values in flat(model.arrays).items():
        np.testing.assert_array_equal(values, before[name])  # nobody wrote into the model


def test_data_that_are_reset_are_as_new(model: ContactModel, paths: list[np.ndarray]) -> None:
    data = model.data()
    first = follow(data, paths[0])
    data.out.force_error[:] = 1.0
    data.reset()
    assert np.isnan(data.out.force_error).all()  # until it is estimated again
    for name, values in flat(data.state).items():
        if not name.startswith("out."):
            np.testing.assert_array_equal(values, flat(model.data().state)[name])
    np.testing.assert_array_equal(follow(data, paths[0]), first)
