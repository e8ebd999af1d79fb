"""A soft box for large deformation, and checks of every path through it.

The checks: steps taken, elements turned over, work of the force against the stored energy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from avatar_core.errors import EquilibriumError
from avatar_core.fem.elasticity import Material
from avatar_core.fem.hyperelastic_materials import HyperelasticMaterial
from avatar_core.fem.hyperelasticity import Hyperelasticity
from avatar_core.fem.newton import NewtonRule, State, _DepthControl, _march, _Newton
from tests.helpers.elastic_shapes import box_mesh, box_regions, nodes_of

LENGTH = 0.1  # [m]
YOUNG = 1000.0  # [Pa]
SOFT = Material(YOUNG, 0.4)
ROTATION = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])


def box(material: HyperelasticMaterial, n: int = 2) -> Hyperelasticity:
    mesh = box_mesh(n, 3 * (LENGTH,))
    return Hyperelasticity(mesh, material, box_regions(mesh).clamped)


def stretched(problem: Hyperelasticity, s: float) -> np.ndarray:
    """Return the displacement of y -> s y."""
    return (nodes_of(problem) * [0.0, s - 1.0, 0.0]).ravel()


def bent(problem: Hyperelasticity) -> np.ndarray:
    """Return a displacement of up to 40 mm that vanishes at the clamp y = 0."""
    x, y, z = 10.0 * nodes_of(problem).T
    return (0.03 * np.stack([y**2, 0.5 * y * (1.0 - x), y * z], axis=1)).ravel()


def held(problem: Hyperelasticity, dofs: np.ndarray) -> np.ndarray:
    """Return a unit load for each of these degrees of freedom, shape (3 n_nodes, n)."""
    unit = np.zeros((3 * problem.n_nodes, len(dofs)))
    unit[dofs, np.arange(len(dofs))] = 1.0
    return unit


def followed(
    problem: Hyperelasticity, loads: np.ndarray, motions: Sequence[np.ndarray]
) -> Iterator[State]:
    """Solve one imposed motion after the other; ``press`` starts each from rest."""
    displacement = np.zeros(3 * problem.n_nodes)
    for motion in motions:
        newton = _DepthControl(problem, loads[problem.free], motion, NewtonRule())
        newton.rest = replace(newton.rest, displacement=displacement)
        state = next(_march(newton, [1.0]))
        displacement = state.displacement
        yield state


@contextmanager
def accepted_steps() -> Iterator[list[State]]:
    """Record every step that Newton's method accepts, also those that it does not return."""
    states: list[State] = []
    advance = _Newton.advance

    def recorded(self: _Newton, state: State, aim: float) -> State:
        states.append(advance(self, state, aim))
        return states[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_Newton, "advance", recorded)
        yield states


def least_det(problem: Hyperelasticity, displacement: np.ndarray) -> float:
    """Return the smallest det F at quadrature points and corners, by formulas of its own.

    Along the edge from corner i to j, x = X + u changes by 4 x_ij - 3 x_i - x_j at i.
    """
    inside = np.linalg.det(problem.deformation_gradient(displacement)).min()
    X, number = nodes_of(problem), np.zeros((4, 4), int)
    for column, (i, j) in enumerate([(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)], start=4):
        number[i, j] = number[j, i] = column
    x, corner = X + displacement.reshape(-1, 3), [inside]
    for i in range(4):
        others = [j for j in range(4) if j != i]
        end = problem.nodes[:, others]
        start, middle = problem.nodes[:, [i]], problem.nodes[:, number[i, others]]
        bent = np.linalg.det(4.0 * x[middle] - 3.0 * x[start] - x[end])
        corner.append((bent / np.linalg.det(X[end] - X[start])).min())
    return float(min(corner))


def stored_and_done(depths: np.ndarray, forces: np.ndarray) -> tuple[np.ndarray, float]:
    """Integrate the force over the depth by a spline; return the work and its error bound.

    The error bound is the change when every second state is dropped: the rule is of fourth order.
    """
    work = CubicSpline(depths, forces).antiderivative()(depths)
    kept = np.unique([0, *range(len(depths) - 1, 0, -2)])
    coarse = CubicSpline(depths[kept], forces[kept]).antiderivative()(depths[kept])
    return work, float(np.abs(coarse - work[kept]).max())


def carried(states: Iterator[State]) -> tuple[list[State], str]:
    """Return the states before equilibrium is lost, and the error message, "" if none."""
    found: list[State] = []
    try:
        found.extend(states)
    except EquilibriumError as error:
        assert "\n" not in str(error)
        return found, str(error)
    return found, ""
