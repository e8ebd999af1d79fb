"""Stable equilibria at large deformation: Newton's method as a descent of the energy.

:func:`solve` carries a given dead load; :func:`press` pushes a load's patch to given depths. Both
march in steps that halve where Newton fails and double where it is quick, and minimise

    Pi(u) = int psi dx - f . u    over all u (solve), over those with C^T u = depth n (press).

Under an imposed motion of the patch, the force is the multiplier of the constraint. This finds
states that a growing force would skip by snapping through. Equilibrium is lost in three cases. No
step lowers the energy without turning an element inside out. The tangent is not positive definite.
Or the state found is far from the tangent's prediction, however small the step.

Newton's systems are solved by conjugate gradients, preconditioned by the LDL^T factor of an earlier
tangent: a factor costs as much as some 50 iterations. Source: Nocedal and Wright, Numerical
Optimization, 2006. Alg. 3.1 is the line search, Alg. 7.1 the truncated Newton step, here refused at
negative curvature, and Alg. 16.2 the projection onto the constraint.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import rslab
import scipy.sparse as sp

from avatar_core.errors import EquilibriumError, LoadError
from avatar_core.fem.hyperelasticity import Hyperelasticity

_DESCENT = 1e-4  # Armijo's fraction of the decrease that the slope promises
_NOISE = 1e-15  # rounding of the energy, over Young's modulus times the volume
_HALVINGS = 8  # halvings of a Newton step, before the state counts as lost
_QUICK = 5  # Newton iterations up to which the next load step doubles
_MOST_INNER = 200  # conjugate gradient iterations of one system
_STALE = 25  # conjugate gradient iterations of one system that make a new factor pay
_STRAYED = 0.2  # way from the predicted state, over the step, that is no longer the same branch
_PREDICTED = 1e-2  # accuracy of the tangent that predicts the next state


@dataclass(frozen=True)
class NewtonRule:
    """Tolerances and step sizes of Newton's method.

    Attributes
    ----------
    tolerance : float
        Tolerance of the residual over the load, 2-norms over the free degrees of freedom.
    max_iterations : int
        Largest number of Newton iterations in one load step.
    first_step, least_step : float
        Fractions of the whole load or depth.
    exact_stability : bool
        Count the negative pivots at every state returned, at the cost of a factorization each.
        Otherwise instability is noticed only where the conjugate gradients meet it.
    """

    tolerance: float = 1e-6
    max_iterations: int = 12
    first_step: float = 0.25
    least_step: float = 1.0 / 64.0
    exact_stability: bool = True


@dataclass(frozen=True)
class State:
    """One equilibrium.

    Attributes
    ----------
    displacement : ndarray, shape (3 n_nodes,)
        Displacement [m].
    force : ndarray, shape (n_loads,)
        Factors of the given loads; [N] for unit loads.
    depth : float
        Depth of the patch, for :func:`press` [m].
    residuals : ndarray, shape (n_iterations + 1,)
        Residual over load in the last load step.
    min_det : float
        Smallest det F over quadrature points and corners of the elements.
    newton_iterations : int
        Number of iterations since the state before, load steps that failed included.
    """

    displacement: np.ndarray
    force: np.ndarray
    depth: float
    residuals: np.ndarray
    min_det: float
    newton_iterations: int


def solve(problem: Hyperelasticity, load: np.ndarray, rule: NewtonRule | None = None) -> State:
    """Return the equilibrium under a dead load, reached from rest by load steps.

    Parameters
    ----------
    load : ndarray, shape (3 n_nodes,)
        Dead load [N].
    rule : NewtonRule or None
        Tolerances and step sizes.

    Raises
    ------
    EquilibriumError
        If equilibrium is lost before the whole load is carried.
    """
    newton = _LoadControl(problem, _free_load(problem, load), rule or NewtonRule())
    return next(_march(newton, [1.0]))


def press(
    problem: Hyperelasticity,
    loads: np.ndarray,
    motion: np.ndarray,
    depths: Sequence[float],
    rule: NewtonRule | None = None,
    preload: np.ndarray | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Iterator[State]:
    """Yield equilibria of a patch that is moved to increasing depths, like by a tool that holds it.

    With all three directions of the patch, its mean displacement is imposed. The patch then cannot
    tip over sideways, unlike under a dead load. With the normal direction alone it is free to
    slide.

    Parameters
    ----------
    loads : ndarray, shape (3 n_nodes, m)
        C, unit loads of the patch: columns of ``patch_loads``, or combinations of them.
        ``State.force`` holds their factors [N].
    motion : ndarray, shape (m,)
        n: C^T u = depth n.
    depths : Sequence[float]
        Increasing and positive [m].
    rule : NewtonRule or None
        Tolerances and step sizes.
    preload : ndarray, shape (3 n_nodes,)
        A dead load, e.g. weight, carried before and during the push; depths count from there.
    progress : Callable[[float], None]
        Called at every Newton iteration with the fraction of the last depth that is reached.

    Raises
    ------
    EquilibriumError
        If equilibrium is lost before the last depth; the states before it have been yielded.
    """
    if len(depths) == 0 or not (np.diff([0.0, *depths]) > 0).all():
        raise LoadError(f"the depths are {list(depths)}; give increasing ones above 0 m")
    held = np.stack([_free_load(problem, load) for load in np.atleast_2d(loads.T)], axis=1)
    rule = rule or NewtonRule()
    newton = _DepthControl(problem, held, np.asarray(motion, float), rule)
    if preload is not None:
        newton.load = _free_load(problem, preload)
        newton.rest = replace(newton.rest, displacement=solve(problem, preload, rule).displacement)
    return _march(newton, list(depths), progress)


def _free_load(problem: Hyperelasticity, load: np.ndarray) -> np.ndarray:
    """Return the load on the free degrees of freedom, shape (n_free,) [N]."""
    if load.shape != (3 * problem.n_nodes,) or not np.isfinite(load).all():
        raise LoadError(
            f"the load has the shape {load.shape}; give {3 * problem.n_nodes} finite nodal forces, "
            "one column of patch_loads made dense"
        )
    if not load[problem.free].any():
        raise LoadError("the load is zero on all free nodes; press where the organ is not clamped")
    return load[problem.free]


def _march(
    newton: _Newton, targets: list[float], progress: Callable[[float], None] = lambda fraction: None
) -> Iterator[State]:
    """Yield the states at increasing targets of load factor or depth, in steps of adapted size."""
    rule, whole = newton.rule, targets[-1]
    state, reached, step = newton.rest, 0.0, rule.first_step * whole
    stable, careful = (state, reached), False
    newton.on_iteration = lambda: progress(reached / whole)
    for target in targets:
        newton.iterations = 0
        while reached < target:
            aim = target if reached + 1.01 * step >= target else reached + step
            try:
                new = newton.advance(state, aim)
                if rule.exact_stability and (careful or aim == target):
                    newton.check_stability(new)
                    stable = new, aim
            except _LostError as lost:
                if rule.exact_stability and not careful:
                    # equilibrium may have been lost at a step before, where it was not checked
                    careful, (state, reached) = True, stable
                step = (aim - reached) / 2.0
                if step < rule.least_step * whole:
                    raise EquilibriumError(
                        f"equilibrium is lost beyond {newton.quantity} {reached:.3g} of "
                        f"{whole:.3g} ({lost}); press less, on a wider patch, or take the "
                        "neo-Hookean material"
                    ) from None
            else:
                state, reached = new, aim
                step *= 2.0 if len(state.residuals) <= 1 + _QUICK else 1.0
        yield replace(state, newton_iterations=newton.iterations)


class _LostError(Exception):
    """One load step failed; the message says how."""


class _Newton(ABC):
    """Newton's method along one load.

    load : ndarray, shape (n_free,), dead load
    held : ndarray, shape (n_free, m), C of the constraint C^T u = const, or None
    iterations : counter of iterations
    on_iteration : called at each iteration
    """

    quantity: str

    def __init__(
        self,
        problem: Hyperelasticity,
        load: np.ndarray,
        rule: NewtonRule,
        held: np.ndarray | None = None,
    ) -> None:
        self.problem, self.rule, self.load, self.held = problem, rule, load, held
        n_loads = 1 if held is None else held.shape[1]
        self.rest = State(
            np.zeros(3 * problem.n_nodes), np.zeros(n_loads), 0.0, np.zeros(1), 1.0, 0
        )
        self.iterations = 0
        self.on_iteration: Callable[[], None] = lambda: None
        self._use(problem.rest_factor)

    @abstractmethod
    def _coordinate(self, state: State) -> float:
        """Return the coordinate of the march: the load factor or the depth."""

    @abstractmethod
    def _slope(self, u: np.ndarray) -> np.ndarray:
        """Return du / d(coordinate) at an equilibrium, shape (n_free,)."""

    @abstractmethod
    def _dead_load(self, aim: float) -> np.ndarray:
        """Return the dead load, shape (n_free,) [N]; zero where the load is a multiplier."""

    def advance(self, state: State, aim: float) -> State:
        """Return the next equilibrium, started from u + (aim - coordinate) du/d(coordinate)."""
        free = self.problem.free
        step = (aim - self._coordinate(state)) * self._slope(state.displacement)
        start = state.displacement.copy()
        start[free] += step
        if not np.isfinite(self.problem.energy(start)):
            raise _LostError("the predicted state turns elements inside out")
        u, residuals = self._descend(start, self._dead_load(aim))
        if np.linalg.norm(u - start) > _STRAYED * np.linalg.norm(step):
            raise _LostError("the organ snaps to another shape")
        new = self._state(u, aim, residuals)
        if not new.min_det > 0.0:  # at a corner, which the energy does not see
            raise _LostError("a corner of an element turns inside out")
        return new

    def _state(self, u: np.ndarray, aim: float, residuals: list[float]) -> State:
        """Return the state at the target; multipliers replace the load factor."""
        free, force, depth = self.problem.free, np.array([aim]), 0.0
        if self.held is not None:
            force, depth = self._multipliers(self.problem.forces(u)[free] - self.load), aim
        det = self.problem.min_det(u)
        return State(u, force, depth, np.array(residuals), det, self.iterations)

    def check_stability(self, state: State) -> None:
        """Refuse a state whose tangent has a negative direction among the free ones."""
        factor = self._factorize(self.problem.tangent(state.displacement))
        _, negative, zero = factor.inertia
        if negative + zero == 0:
            self._use(factor)
        elif negative + zero > self._taken_by_constraint(factor):
            raise _LostError(f"nothing resists {negative + zero} ways to deform it further")

    def _taken_by_constraint(self, factor: rslab.Ldlt) -> int:
        """Return number of negative directions that the constraint removes: those of C^T K^-1 C."""
        if self.held is None:
            return 0
        compliance = self.held.T @ factor.solve_many(np.asfortranarray(self.held))
        return int((np.linalg.eigvalsh((compliance + compliance.T) / 2.0) < 0.0).sum())

    def _factorize(self, tangent: sp.csc_matrix) -> rslab.Ldlt:
        try:
            return self.problem.factorize(tangent)
        except RuntimeError as error:  # rslab: a pivot is zero
            raise _LostError("the tangent is singular") from error

    def _use(self, factor: rslab.Ldlt) -> None:
        """Use the factor of a positive definite tangent as preconditioner from now on."""
        self._factor, self._stale = factor, False
        if self.held is not None:
            slope = factor.solve_many(np.asfortranarray(self.held))
            self._unit_slopes = slope @ np.linalg.inv(self.held.T @ slope)

    def _precondition(self, residual: np.ndarray) -> np.ndarray:
        """Return M^-1 r, projected so that C^T u does not change."""
        direction = self._factor.solve(residual)
        if self.held is not None:
            direction -= self._unit_slopes @ (self.held.T @ direction)
        return direction

    def _multipliers(self, gradient: np.ndarray) -> np.ndarray:
        """Return the factors of the held loads that best balance a gradient, shape (m,)."""
        assert self.held is not None
        return np.linalg.solve(self.held.T @ self.held, self.held.T @ gradient)

    def _gradient(self, u: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, float]:
        """Return d Pi / du along the constraint, (n_free,), and its norm over the load's norm."""
        gradient = self.problem.forces(u)[self.problem.free] - load
        if self.held is None:
            return gradient, float(np.linalg.norm(gradient) / np.linalg.norm(load))
        force = self.held @ self._multipliers(gradient)
        gradient = gradient - force
        return gradient, float(np.linalg.norm(gradient) / np.linalg.norm(force))

    def _descend(self, u: np.ndarray, load: np.ndarray) -> tuple[np.ndarray, list[float]]:
        """Return the minimiser of Pi near u under the constraint, and the residuals on the way."""
        gradient, residual = self._gradient(u, load)
        residuals = [residual]
        while not residual <= self.rule.tolerance:
            if len(residuals) > self.rule.max_iterations:
                raise _LostError(f"no convergence in {self.rule.max_iterations} Newton iterations")
            # as accurate as the Newton step itself, which keeps the convergence quadratic
            forcing = max(min(0.1, residual), 0.1 * self.rule.tolerance / residual)
            self.iterations += 1
            self.on_iteration()
            direction = self._direction(self.problem.tangent(u), -gradient, forcing)
            u = self._line_search(u, load, gradient, direction)
            gradient, residual = self._gradient(u, load)
            residuals.append(residual)
        return u, residuals

    def _line_search(
        self, u: np.ndarray, load: np.ndarray, gradient: np.ndarray, direction: np.ndarray
    ) -> np.ndarray:
        """Return first of u + s, u + s/2, u + s/4, ... that lowers the energy enough (Armijo)."""
        free = self.problem.free
        start = self.problem.energy(u)
        slope = float(gradient @ direction)
        material, volume = self.problem.material.linear, self.problem.mesh.volume
        noise = _NOISE * material.young_modulus * volume
        for halving in range(_HALVINGS):
            length = 0.5**halving
            new = u.copy()
            new[free] += length * direction
            change = self.problem.energy(new) - start - length * float(load @ direction)
            if change <= _DESCENT * length * slope + noise:
                return new
        raise _LostError("no step lowers the energy without turning elements inside out")

    def _direction(
        self, tangent: sp.csc_matrix, right: np.ndarray, forcing: float, enough: float = 0.0
    ) -> np.ndarray:
        """Return K^-1 r in the free directions, by projected conjugate gradients.

        After ``_MOST_INNER`` iterations the direction is inexact but still a descent direction. The
        line search and the residual of Newton's method decide whether it is used.

        forcing : reduction of the residual r . M^-1 r, as a norm
        enough : r . M^-1 r [J] that is small whatever it was at the start
        """
        if self._stale:
            self._renew(tangent)
        solution, residual, iteration = np.zeros_like(right), right, 0
        z = self._precondition(residual)
        p, rz = z, float(residual @ z)
        goal = max(forcing**2 * rz, enough)
        while rz > goal and iteration < _MOST_INNER:
            Kp = _times(tangent, p)
            curvature = float(p @ Kp)
            if curvature <= 0.0:
                raise _LostError("the tangent is not positive definite")
            solution = solution + (rz / curvature) * p
            residual = residual - (rz / curvature) * Kp
            z = self._precondition(residual)
            rz, before = float(residual @ z), rz
            p, iteration = z + (rz / before) * p, iteration + 1
        self._stale = iteration > _STALE
        return solution

    def _renew(self, tangent: sp.csc_matrix) -> None:
        factor = self._factorize(tangent)
        self._stale = False
        if factor.inertia[1:] == (0, 0):
            self._use(factor)


class _LoadControl(_Newton):
    """Equilibria under load_factor times the load."""

    quantity = "load factor"

    def _coordinate(self, state: State) -> float:
        return float(state.force[0])

    def _dead_load(self, aim: float) -> np.ndarray:
        return aim * self.load

    def _slope(self, u: np.ndarray) -> np.ndarray:
        """Return K^-1 f."""
        return self._direction(self.problem.tangent(u), self.load, _PREDICTED)


class _DepthControl(_Newton):
    """Equilibria of an imposed motion of the patch; the forces are its multipliers."""

    quantity = "depth [m]"

    def __init__(
        self, problem: Hyperelasticity, held: np.ndarray, motion: np.ndarray, rule: NewtonRule
    ) -> None:
        super().__init__(problem, np.zeros(len(held)), rule, held)
        self._motion = motion

    def _coordinate(self, state: State) -> float:
        return state.depth

    def _dead_load(self, aim: float) -> np.ndarray:
        return self.load

    def _slope(self, u: np.ndarray) -> np.ndarray:
        """Return s with C^T s = n of least s . K s."""
        tangent = self.problem.tangent(u)
        start = self._unit_slopes @ self._motion
        force = _times(tangent, start)
        right = self.held @ self._multipliers(force) - force
        enough = _PREDICTED**2 * float(start @ force)
        return start + self._direction(tangent, right, _PREDICTED, enough)


def _times(lower: sp.csc_matrix, vector: np.ndarray) -> np.ndarray:
    """Return the product with a symmetric matrix whose lower triangle is stored."""
    return lower @ vector + lower.T @ vector - lower.diagonal() * vector
