"""A rigid sphere pressed into a half-space by finite elements, at small and at large strain.

Without friction, the equilibrium at the depth d minimises the energy

    Pi(u) = int psi(F) 2 pi r dr dz + epsilon / 2 int <-g>^2 2 pi r dr,

g being the gap between a point of the surface and the sphere, which ends at z = -d. At large strain
g = |x - c| - R, x = (r + u_r, u_z), c = (0, R - d). At small strain, Sneddon's problem (Int. J.
Eng. Sci. 3:47, 1965), the gap is along z at the undeformed radius, R - sqrt(R^2 - r^2) - d - u_z.
The force is dPi / dd. Lengths are in radii of the sphere and stresses in Young's moduli.

The penalty epsilon lets the sphere penetrate by p / epsilon, 1e-4 R at most at the default. A
cylinder of 1000 R (:mod:`avatar_core.fem.axisymmetric`) stands for the half-space.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from avatar_core.errors import ConvergenceError
from avatar_core.fem.axisymmetric import AxisymmetricBody
from avatar_core.fem.elasticity import Material
from avatar_core.fem.hyperelastic_materials import (
    HyperelasticMaterial,
    NeoHookean,
    StVenantKirchhoff,
)

_FINE = 1.2  # radius and depth of the part with elements of one size [R]
_GROWTH = 0.25  # growth of elements beyond it: their size over the distance from it
_STEP, _LEAST_STEP = 0.1, 0.01  # steps of the depth [R]
_MAX_ITERATIONS = 25
_MAX_HALVINGS = 12
_ROUNDING = 1e-16  # rounding of the energy, over the volume
_MOST_PRESSURE = 3.0  # in the tangent [E]
_TOLERANCE = 1e-7  # tolerance of the residual, relative to the force


@dataclass(frozen=True)
class Domain:
    """The cylinder that stands for the half-space, and the elements of its body.

    Attributes
    ----------
    element : float
        Size of the elements around the contact [R].
    extent : float
        Radius and height of the cylinder [R].
    penalty : float
        epsilon [E / R].
    """

    element: float = 0.1
    extent: float = 1000.0
    penalty: float = 1e4


class Indentation(NamedTuple):
    """Equilibrium at one depth.

    Attributes
    ----------
    depth : float
        Depth [R].
    force : float
        Force [E R^2].
    energy : float
        Pi [E R^3].
    contact : float
        Largest deformed radius at which the sphere touches [R].
    min_det : float
        Least det F.
    """

    depth: float
    force: float
    energy: float
    contact: float
    min_det: float


@dataclass(frozen=True)
class _Hooke:
    """Energy psi = lambda / 2 (tr eps)^2 + mu eps:eps of the small strain eps = sym(F) - I."""

    linear: Material

    def energy(self, F: np.ndarray) -> np.ndarray:
        return 0.5 * np.einsum("...ij,...ij->...", F - np.eye(3), self.stress(F))

    def stress(self, F: np.ndarray) -> np.ndarray:
        lam, mu = self.linear.lame
        strain = 0.5 * (F + np.swapaxes(F, -1, -2)) - np.eye(3)
        trace = np.einsum("...ii->...", strain)[..., None, None]
        return lam * trace * np.eye(3) + 2.0 * mu * strain

    def tangent(self, F: np.ndarray) -> np.ndarray:
        # at rest every material of the project is Hooke's
        rest = StVenantKirchhoff(self.linear).tangent(np.eye(3))
        return np.broadcast_to(rest, (*F.shape[:-2], 3, 3, 3, 3))


class _State(NamedTuple):
    depth: float
    u: np.ndarray
    rate: np.ndarray  # du over the last step of the depth


class SphereIndentation:
    """The problem of one material on one mesh.

    Parameters
    ----------
    large_strain : bool
        Whether the material is neo-Hookean and contact is on the deformed surface; otherwise
        Sneddon's problem.
    """

    def __init__(
        self, poisson_ratio: float, large_strain: bool = True, domain: Domain | None = None
    ) -> None:
        self.domain, self.large_strain = domain or Domain(), large_strain
        linear = Material(1.0, poisson_ratio)
        material: HyperelasticMaterial = NeoHookean(linear) if large_strain else _Hooke(linear)
        self.body = AxisymmetricBody(_ticks(self.domain), material)
        self._rounding = _ROUNDING * float(self.body.volume.sum())

    def press(self, depths: Iterable[float]) -> list[Indentation]:
        """Return the equilibria at rising depths [R].

        Raises
        ------
        ConvergenceError
            If Newton's method does not converge, as where elements would turn inside out.
        """
        state = _State(0.0, np.zeros_like(self.body.places), np.zeros_like(self.body.places))
        found = []
        for depth in depths:
            state = self._advance(state, depth)
            found.append(self._indentation(state.u, depth))
        return found

    def _advance(self, state: _State, depth: float) -> _State:
        """Return the equilibrium at a depth, in steps that halve where Newton's method fails."""
        step = min(_STEP, depth - state.depth)
        while state.depth < depth - 1e-12:
            step = min(step, depth - state.depth)
            target = state.depth + step
            ahead = state.u + step * state.rate
            straight = self._energy(ahead, target) < self._energy(state.u, target)
            try:
                u = self._equilibrium(ahead if straight else state.u, target)
            except ConvergenceError:
                step *= 0.5
                if step < _LEAST_STEP:
                    raise
                continue
            state = _State(target, u, (u - state.u) / step)
        return state

    def _equilibrium(self, u: np.ndarray, depth: float) -> np.ndarray:
        """Return the equilibrium at a depth, by Newton's method as a descent of the energy."""
        free = self.body.free
        for _ in range(_MAX_ITERATIONS):
            residual, force = self._residual(u, depth)
            if force > 0.0 and np.abs(residual[free]).max() < _TOLERANCE * force:
                return u
            change = np.zeros_like(residual)
            factor = self.body.factorize(u, self._contact_tangent(u, depth))
            change[free] = -factor.solve(residual[free])
            part, descent, energy = 1.0, float(residual @ change), self._energy(u, depth)
            for _ in range(_MAX_HALVINGS):
                new = u + part * change.reshape(-1, 2)
                if self._energy(new, depth) <= energy + 1e-4 * part * descent + self._rounding:
                    break
                part *= 0.5
            else:
                break
            u = new
        raise ConvergenceError(
            f"no equilibrium at a depth of {depth:g} R; elements turn inside out, take others"
        )

    def _gap(self, u: np.ndarray, depth: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return g at the surface, its gradient by u (..., 2) and, at large strain, 1 / |x - c|."""
        moved = np.einsum("fqa,fad->fqd", self.body.top_shape, u[self.body.top])
        r = self.body.top_radius
        if not self.large_strain:
            under = np.sqrt(np.maximum(1.0 - r**2, 0.0))
            gap = np.where(r < 1.0, 1.0 - under - depth - moved[..., 1], np.inf)
            return gap, np.broadcast_to([0.0, -1.0], moved.shape), np.zeros_like(gap)
        offset = np.stack([r + moved[..., 0], moved[..., 1] - 1.0 + depth], axis=-1)
        distance = np.linalg.norm(offset, axis=-1)
        return distance - 1.0, offset / distance[..., None], 1.0 / distance

    def _energy(self, u: np.ndarray, depth: float) -> float:
        """Return Pi, infinite where a quadrature point is inverted."""
        if self.large_strain and self.body.min_det(u) <= 0.0:
            return np.inf
        into = np.maximum(-self._gap(u, depth)[0], 0.0)
        return self.body.energy(u) + 0.5 * self.domain.penalty * float(
            (self.body.top_area * into**2).sum()
        )

    def _residual(self, u: np.ndarray, depth: float) -> tuple[np.ndarray, float]:
        """Return dPi / du, shape (2 n_nodes,), and dPi / dd."""
        gap, normal, _ = self._gap(u, depth)
        pressure = self.domain.penalty * np.maximum(-gap, 0.0) * self.body.top_area
        outer = -np.einsum("fq,fqa,fqd->fad", pressure, self.body.top_shape, normal)
        # a deeper sphere closes the gap as a rising surface does: dg / dd = dg / du_z
        force = -float((pressure * normal[..., 1]).sum())
        return self.body.forces(u) + self.body.gathered(self.body.top, outer), force

    def _contact_tangent(self, u: np.ndarray, depth: float) -> np.ndarray:
        """Return the penalty energy's second derivative at each edge, shape (n_edges, 18, 18)."""
        gap, normal, curvature = self._gap(u, depth)
        touching = self.domain.penalty * self.body.top_area * (gap < 0.0)
        along = np.einsum("fqi,fqj->fqij", normal, normal)
        # of pressures that occur: a guess that lies far in the sphere would make it indefinite
        pushed = np.clip(gap, -_MOST_PRESSURE / self.domain.penalty, 0.0)
        bend = (pushed * curvature)[..., None, None] * (np.eye(2) - along)
        local = touching[..., None, None] * (along + bend)
        shape = self.body.top_shape
        return np.einsum("fqa,fqb,fqij->faibj", shape, shape, local).reshape(-1, 18, 18)

    def _indentation(self, u: np.ndarray, depth: float) -> Indentation:
        _, force = self._residual(u, depth)
        gap, _, _ = self._gap(u, depth)
        moved = np.einsum("fqa,fa->fq", self.body.top_shape, u[self.body.top][..., 0])
        radius = self.body.top_radius + (moved if self.large_strain else 0.0)
        contact = float(radius[gap < 0.0].max(initial=0.0))
        return Indentation(depth, force, self._energy(u, depth), contact, self.body.min_det(u))


def _ticks(domain: Domain) -> np.ndarray:
    """Return edges of the elements along r and -z: equal around the contact, then growing."""
    ticks = [0.0]
    while ticks[-1] < domain.extent:
        ticks.append(ticks[-1] + max(domain.element, _GROWTH * (ticks[-1] - _FINE)))
    return np.array(ticks) * domain.extent / ticks[-1]
