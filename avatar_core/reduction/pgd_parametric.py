"""Proper Generalized Decomposition with any number of coordinates.

For an affine problem over places x, loads s and parameters p = (p_1, p_2, ...),

    sum_q [prod_d theta_q^d(p_d)] K_q u(x, s, p) = sum_j F_j(x, s) prod_d phi_j^d(p_d),

greedy enrichment seeks u = sum_k X_k(x) S_k(s) prod_d P_k^d(p_d), one product at a time, by
alternating directions: the weak form is tested with R S P, where all factors but one are known,

    [sum_q a_q K_q] R = right-hand side,    a_q = (S, S) prod_d (P^d, theta_q^d P^d),

and likewise for S and every P^d, which are scalar equations at each load and each node of a
parameter. After every product the functions of s and of all parameters are computed anew by a
Galerkin projection onto the others (Chinesta, Keunings & Leygue, The Proper Generalized
Decomposition for Advanced Numerical Simulations, 2014, ch. 2-3; Nouy, CMAME 199:1603, 2010).

Vademecums are not built by it: a space basis with small systems
(:mod:`avatar_core.offline.parametric`) needs fewer modes and does not stagnate towards
incompressibility (``avatar study coordinates``). It is the form to take for many parameters, as
the basis needs solutions on a grid of all of them.

Operators are symmetric and positive (semi-)definite, coordinates are discretised by nodes with
quadrature weights, their norm. :func:`minimal_residual` gives the normal equations as another
problem of the same form.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from scipy.sparse.linalg import LinearOperator, cg

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import ConvergenceError
from avatar_core.reduction.affine import AffineProblem, CanonicalField, Samples

# A product that holds less of the energy than this is made of rounding errors, and those after it
# of theirs.
_ROUNDING = 1e-26


class Outcome(Enum):
    """How an enrichment, or the whole decomposition, ended."""

    CONVERGED = "converged"
    EXHAUSTED = "exhausted"  # the residual is rounding; nothing was added
    SWEEP_LIMIT = "sweep limit"  # accepted: the product lowers the error, less than it could
    STAGNATED = "stagnated"  # the last enrichments hardly lowered the residual
    MODE_LIMIT = "mode limit"  # the tolerance was not met with the modes allowed


@dataclass(frozen=True)
class Enrichment:
    """One product: how it ended, its sweeps, the change in the last, and the residual after it.

    residual : |r| / |f| in the norm of K_0^-1, over sampled loads and nodes
    """

    outcome: Outcome
    sweeps: int
    change: float
    residual: float


@dataclass(frozen=True)
class CanonicalPGDRule:
    """When to stop.

    max_modes : products at most; tolerance : of the relative residual
    max_sweeps, sweep_tolerance : of alternating directions, by the change of the product
    solve_tolerance : of the conjugate gradients for X
    update : compute the functions of all products anew after each
    stall : stagnation is a residual that fell less than ``least_gain`` over so many products
    n_samples : points (s, p) at which the residual is measured
    """

    max_modes: int
    tolerance: float = 1e-3
    max_sweeps: int = 8
    sweep_tolerance: float = 3e-2
    solve_tolerance: float = 1e-3
    update: bool = True
    stall: int = 8
    least_gain: float = 0.05
    n_samples: int = 24


@dataclass(frozen=True, eq=False)
class CanonicalPGDSolution:
    """The field, how it ended and how it got there."""

    field: CanonicalField
    outcome: Outcome
    history: tuple[Enrichment, ...]

    @property
    def converged(self) -> bool:
        """The tolerance or rounding was met and no enrichment had to be cut short."""
        cut = any(step.outcome is Outcome.SWEEP_LIMIT for step in self.history)
        return self.outcome in (Outcome.CONVERGED, Outcome.EXHAUSTED) and not cut


def solve_canonical_pgd(
    problem: AffineProblem,
    rule: CanonicalPGDRule,
    progress: Callable[[int, float], None] = lambda rank, residual: None,
) -> CanonicalPGDSolution:
    """Greedy enrichment with alternating directions until the rule stops it.

    Parameters
    ----------
    progress : called with rank and residual after every product

    Raises
    ------
    ConvergenceError
        If the right-hand side is zero, or a linear system could not be solved.
    """
    expansion = _Expansion(problem)
    samples = Samples(problem, rule.n_samples)
    history: list[Enrichment] = []
    while len(history) < rule.max_modes:
        product, outcome, sweeps, change = _enrich(expansion, rule)
        if product is None:
            return CanonicalPGDSolution(expansion.field, Outcome.EXHAUSTED, tuple(history))
        expansion.append(product)
        if rule.update:
            expansion.update()
        history.append(Enrichment(outcome, sweeps, change, samples.residual(expansion.field)))
        progress(len(history), history[-1].residual)
        if history[-1].residual <= rule.tolerance:
            return CanonicalPGDSolution(expansion.field, Outcome.CONVERGED, tuple(history))
        if _stagnated(history, rule):
            return CanonicalPGDSolution(expansion.field, Outcome.STAGNATED, tuple(history))
    return CanonicalPGDSolution(expansion.field, Outcome.MODE_LIMIT, tuple(history))


def _stagnated(history: list[Enrichment], rule: CanonicalPGDRule) -> bool:
    if len(history) <= rule.stall:
        return False
    return history[-1].residual > (1.0 - rule.least_gain) * history[-1 - rule.stall].residual


# --- one product ------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Product:
    """R S prod_d P^d with unit P^d, the rows R . K_q X_k (last: R . K_q R), and its energy."""

    space: FloatArray
    load: FloatArray
    parameters: tuple[FloatArray, ...]
    rows: FloatArray  # (n_terms, rank + 1)
    energy: float


def _enrich(
    expansion: _Expansion, rule: CanonicalPGDRule
) -> tuple[_Product | None, Outcome, int, float]:
    """Alternating directions from a random load function and constant parameters.

    Where the mean of the residual vanishes, constants find nothing; random parameters may.
    """
    problem = expansion.problem
    rng = np.random.default_rng(expansion.field.rank)
    load = _unit(rng.standard_normal(len(problem.load_weights)), problem.load_weights)
    constant = tuple(_unit(np.ones(len(w)), w) for w in problem.weights)
    found = _alternate(expansion, rule, load, constant)
    if found[0] is None:
        anything = tuple(_unit(rng.standard_normal(len(w)), w) for w in problem.weights)
        found = _alternate(expansion, rule, load, anything)
    return found


def _alternate(
    expansion: _Expansion,
    rule: CanonicalPGDRule,
    load: FloatArray,
    parameters: tuple[FloatArray, ...],
) -> tuple[_Product | None, Outcome, int, float]:
    """Sweeps from a start; no product if what is left is rounding."""
    problem = expansion.problem
    product: _Product | None = None
    change = np.inf
    for sweep in range(1, rule.max_sweeps + 1):
        before = product
        start = None if before is None else before.space
        space = expansion.space_step(load, parameters, rule.solve_tolerance, start)
        rows = expansion.rows(space)
        stiffness = float(rows[:, -1] @ expansion.couplings(parameters)[0])
        if not stiffness > 0.0:
            return None, Outcome.EXHAUSTED, sweep, 0.0
        amplitudes = expansion.load_step(space, rows, parameters)
        size = float(np.sqrt(problem.load_weights @ amplitudes**2))
        energy = size**2 * stiffness
        if energy <= _ROUNDING * expansion.largest:
            return None, Outcome.EXHAUSTED, sweep, 0.0
        load = _unit(amplitudes, problem.load_weights)
        for d in range(len(parameters)):
            found = expansion.parameter_step(d, space, rows, load, parameters)
            parameters = (*parameters[:d], _unit(found, problem.weights[d]), *parameters[d + 1 :])
        product = _Product(space, size * load, parameters, rows, energy)
        change = _change(problem, before, product)
        if change <= rule.sweep_tolerance:
            return product, Outcome.CONVERGED, sweep, change
    assert product is not None
    return product, Outcome.SWEEP_LIMIT, rule.max_sweeps, change


def _change(problem: AffineProblem, before: _Product | None, after: _Product) -> float:
    """|new - old| / |new| of two products, norms of the coordinates."""
    if before is None:
        return np.inf

    def inner(a: _Product, b: _Product) -> float:
        value = float(a.space @ b.space) * float((problem.load_weights * a.load) @ b.load)
        for w, p, q in zip(problem.weights, a.parameters, b.parameters, strict=True):
            value *= float((w * p) @ q)
        return value

    whole = inner(after, after)
    left = whole - 2.0 * inner(after, before) + inner(before, before)
    return float(np.sqrt(max(left, 0.0) / whole)) if whole > 0 else 0.0


def _unit(function: FloatArray, weight: FloatArray) -> FloatArray:
    norm = np.sqrt(weight @ function**2)
    return function / norm if norm > 0 else function


class _Expansion:
    """The growing field, with the products of its space functions that every step needs.

    gram : X^T K_q X, shape (n_terms, rank, rank)
    projected : X^T F_j, shape (n_sources, rank, n_loads)
    largest : energy of the product that held most
    """

    def __init__(self, problem: AffineProblem) -> None:
        self.problem = problem
        n_loads = len(problem.load_weights)
        self.field = CanonicalField(
            np.zeros((problem.n, 0)),
            np.zeros((n_loads, 0)),
            tuple(np.zeros((len(w), 0)) for w in problem.weights),
        )
        self.gram = np.zeros((len(problem.terms), 0, 0))
        self.projected = np.zeros((len(problem.sources), 0, n_loads))
        self.largest = 0.0

    def couplings(
        self, parameters: tuple[FloatArray, ...], skipped: int | None = None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """prod_d over all parameters but one, with the functions P of a product.

        Returns
        -------
        own : (P, theta_q P), shape (n_terms,); others : (P, theta_q P_k), shape (n_terms, rank);
        sources : (P, phi_j), shape (n_sources,)
        """
        problem, rank = self.problem, self.field.rank
        own = np.ones(len(problem.terms))
        others = np.ones((len(problem.terms), rank))
        sources = np.ones(len(problem.sources))
        for d, function in enumerate(parameters):
            if d == skipped:
                continue
            weighted = problem.weights[d] * function
            own = own * (problem.factors[d] @ (weighted * function))
            others = others * ((problem.factors[d] * weighted) @ self.field.parameters[d])
            sources = sources * (problem.source_factors[d] @ weighted)
        return own, others, sources

    def space_step(
        self,
        load: FloatArray,
        parameters: tuple[FloatArray, ...],
        tolerance: float,
        start: FloatArray | None,
    ) -> FloatArray:
        """R: [sum_q a_q K_q] R = sum_j b_j F_j wS - sum_q K_q X c_q, by conjugate gradients."""
        problem = self.problem
        own, others, sources = self.couplings(parameters)
        weighted = problem.load_weights * load
        own = own * float(weighted @ load)
        others = others * (weighted @ self.field.load)
        right = sum(b * (f @ weighted) for b, f in zip(sources, problem.sources, strict=True))
        for term, c in zip(problem.terms, others, strict=True):
            right = right - term @ (self.field.space @ c)

        def apply(vector: FloatArray) -> FloatArray:
            terms = zip(own, problem.terms, strict=True)
            return np.asarray(sum(a * (term @ vector) for a, term in terms))

        operator = LinearOperator((problem.n, problem.n), matvec=apply)
        space, failed = cg(
            operator, right, x0=start, rtol=tolerance, maxiter=500, M=problem.precondition
        )
        if failed or not np.isfinite(space).all():
            raise ConvergenceError(
                "the system for a space function was not solved in 500 iterations; narrow the "
                "ranges of the coordinates"
            )
        return np.asarray(space)

    def rows(self, space: FloatArray) -> FloatArray:
        """R . K_q X_k, and last R . K_q R, shape (n_terms, rank + 1)."""
        images = [term @ space for term in self.problem.terms]
        return np.array([np.append(self.field.space.T @ f, space @ f) for f in images])

    def load_step(
        self, space: FloatArray, rows: FloatArray, parameters: tuple[FloatArray, ...]
    ) -> FloatArray:
        """S(s), a scalar equation at each load; shape (n_loads,)."""
        own, others, sources = self.couplings(parameters)
        right = sum(
            b * f.rmatvec(space) for b, f in zip(sources, self.problem.sources, strict=True)
        )
        known = self.field.load @ (rows[:, :-1] * others).sum(axis=0)
        return np.asarray((right - known) / (rows[:, -1] @ own))

    def parameter_step(
        self,
        d: int,
        space: FloatArray,
        rows: FloatArray,
        load: FloatArray,
        parameters: tuple[FloatArray, ...],
    ) -> FloatArray:
        """P^d(p), a scalar equation at each node of the parameter; shape (n_nodes,)."""
        problem = self.problem
        own, others, sources = self.couplings(parameters, skipped=d)
        weighted = problem.load_weights * load
        stiffness = (rows[:, -1] * own * float(weighted @ load)) @ problem.factors[d]
        work = np.array([space @ (f @ weighted) for f in problem.sources])
        right = (sources * work) @ problem.source_factors[d]
        coupled = rows[:, :-1] * others * (weighted @ self.field.load)
        known = problem.factors[d].T @ coupled  # (n_nodes, rank)
        right = right - (known * self.field.parameters[d]).sum(axis=1)
        return np.asarray(right / stiffness)

    # --- all products -------------------------------------------------------------------------

    def append(self, product: _Product) -> None:
        """Add a product."""
        self.largest = max(self.largest, product.energy)
        rank, old = self.field.rank, self.gram
        self.gram = np.zeros((len(old), rank + 1, rank + 1))
        self.gram[:, :rank, :rank] = old
        self.gram[:, rank, :] = self.gram[:, :, rank] = product.rows
        new = np.array([f.rmatvec(product.space) for f in self.problem.sources])
        self.projected = np.concatenate([self.projected, new[:, None]], axis=1)
        self.field = CanonicalField(
            np.column_stack([self.field.space, product.space]),
            np.column_stack([self.field.load, product.load]),
            tuple(
                np.column_stack([known, p])
                for known, p in zip(self.field.parameters, product.parameters, strict=True)
            ),
        )

    def update(self) -> None:
        """Galerkin projection for all functions of s, then of each parameter, and unit norms."""
        self._update_loads()
        for d in range(len(self.field.parameters)):
            self._update_parameter(d)

    def _grams(self, d: int) -> FloatArray:
        """(P_k^d, theta_q^d P_l^d), shape (n_terms, rank, rank)."""
        functions = self.field.parameters[d]
        weighted = self.problem.factors[d] * self.problem.weights[d]
        return np.einsum("qp,pk,pl->qkl", weighted, functions, functions, optimize=True)

    def _moments(self, d: int) -> FloatArray:
        """(P_k^d, phi_j^d), shape (n_sources, rank)."""
        return (self.problem.source_factors[d] * self.problem.weights[d]) @ self.field.parameters[d]

    def _update_loads(self) -> None:
        stiffness, right = self.gram, self.projected
        for d in range(len(self.field.parameters)):
            stiffness = stiffness * self._grams(d)
            right = right * self._moments(d)[:, :, None]
        load = _solve(stiffness.sum(axis=0), right.sum(axis=0)).T
        self.field = replace(self.field, load=load)

    def _update_parameter(self, d: int) -> None:
        problem, load = self.problem, self.field.load
        weighted = problem.load_weights[:, None] * load
        stiffness = self.gram * (load.T @ weighted)
        right = np.einsum("jkn,nk->jk", self.projected, weighted)
        for e in range(len(self.field.parameters)):
            if e != d:
                stiffness = stiffness * self._grams(e)
                right = right * self._moments(e)
        functions = np.array(
            [
                _solve(np.tensordot(theta, stiffness, 1), phi @ right)
                for theta, phi in zip(
                    problem.factors[d].T, problem.source_factors[d].T, strict=True
                )
            ]
        )
        norm = np.sqrt(problem.weights[d] @ functions**2)
        norm[norm == 0.0] = 1.0
        parameters = list(self.field.parameters)
        parameters[d] = functions / norm
        self.field = CanonicalField(self.field.space, load * norm, tuple(parameters))


def _solve(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Least squares, as two products may share their other functions."""
    scale = 1.0 / np.sqrt(np.maximum(np.diagonal(matrix), 1e-300))
    scaled = scale[:, None] * matrix * scale
    shape = (len(scale),) + (1,) * (right.ndim - 1)
    found = np.linalg.lstsq(scaled, scale.reshape(shape) * right, rcond=1e-12)[0]
    return np.asarray(scale.reshape(shape) * found)


def minimal_residual(problem: AffineProblem) -> AffineProblem:
    """The normal equations: its Galerkin solution minimises the residual in the K_0^-1 norm.

    sum_qq' theta_q theta_q' K_q K_0^-1 K_q' u = sum_qj theta_q phi_j K_q K_0^-1 F_j
    """
    inverse, pairs = problem.precondition, []
    for q, left in enumerate(problem.terms):
        for r, right in enumerate(problem.terms[: q + 1]):
            both = left @ inverse @ right
            pairs.append((q, r, both if q == r else both + right @ inverse @ left))
    sources = [(q, j) for q in range(len(problem.terms)) for j in range(len(problem.sources))]
    return replace(
        problem,
        terms=tuple(operator for _, _, operator in pairs),
        factors=tuple(np.array([f[q] * f[r] for q, r, _ in pairs]) for f in problem.factors),
        sources=tuple(problem.terms[q] @ inverse @ problem.sources[j] for q, j in sources),
        source_factors=tuple(
            np.array([f[q] * g[j] for q, j in sources])
            for f, g in zip(problem.factors, problem.source_factors, strict=True)
        ),
    )
