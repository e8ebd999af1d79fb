"""Hyperelastic materials: energy, stress and tangent as functions of the deformation gradient.

With F = I + grad u, the first Piola stress P = d psi / dF is force per undeformed area. The tangent
A = dP/dF makes Newton's method quadratic. Both materials extend a linear one (Young's modulus,
Poisson's ratio) to large strain: at F = I their tangent is Hooke's.

Source: Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2008, ch. 6.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from avatar_core.fem.elasticity import Material

_IDENTITY = np.eye(3)


class HyperelasticMaterial(Protocol):
    """Interface of a material for the finite elements; F has the shape (..., 3, 3), det F > 0."""

    @property
    def linear(self) -> Material:
        """The material at small strain."""

    def energy(self, F: np.ndarray) -> np.ndarray:
        """Return psi(F), shape (...,) [J/m^3]; zero at F = I."""

    def stress(self, F: np.ndarray) -> np.ndarray:
        """Return P_iJ = d psi / d F_iJ, shape (..., 3, 3) [Pa]."""

    def tangent(self, F: np.ndarray) -> np.ndarray:
        """Return A_iJkL = d P_iJ / d F_kL = A_kLiJ, shape (..., 3, 3, 3, 3) [Pa]."""


@dataclass(frozen=True)
class StVenantKirchhoff:
    """Energy psi = lambda/2 (tr E)^2 + mu E:E with Green's strain E = (F^T F - I) / 2.

    The material suits large rotations, not large compression. A column softens below the stretch
    1/sqrt(3) = 0.577 and costs finite energy at stretch 0. It is the paper's material (Sec. 2.1).
    """

    linear: Material = field(default_factory=Material)

    def energy(self, F: np.ndarray) -> np.ndarray:
        """Return psi(F), shape (...,) [J/m^3]."""
        lam, mu = self.linear.lame
        E = _green(F)
        return 0.5 * lam * _trace(E) ** 2 + mu * np.einsum("...ij,...ij->...", E, E)

    def stress(self, F: np.ndarray) -> np.ndarray:
        """Return P = F S with S = lambda tr(E) I + 2 mu E, shape (..., 3, 3) [Pa]."""
        return F @ self._second_piola(F)

    def tangent(self, F: np.ndarray) -> np.ndarray:
        """Return the derivative of F S, shape (..., 3, 3, 3, 3) [Pa].

        A_iJkL = d_ik S_JL + lambda F_iJ F_kL + mu (F_iL F_kJ + (F F^T)_ik d_JL)
        """
        lam, mu = self.linear.lame
        A = lam * _outer(F, F) + mu * _crossed(F, F)
        A += np.einsum("ik,...jl->...ijkl", _IDENTITY, self._second_piola(F))
        A += np.einsum("...ik,jl->...ijkl", mu * F @ np.swapaxes(F, -1, -2), _IDENTITY)
        return A

    def _second_piola(self, F: np.ndarray) -> np.ndarray:
        lam, mu = self.linear.lame
        E = _green(F)
        return lam * _trace(E)[..., None, None] * _IDENTITY + 2.0 * mu * E


@dataclass(frozen=True)
class NeoHookean:
    """Energy psi = mu/2 (tr F^T F - 3) - mu ln J + lambda/2 (ln J)^2, J = det F.

    The energy grows without bound as J goes to 0: elements resist being crushed.
    """

    linear: Material = field(default_factory=Material)

    def energy(self, F: np.ndarray) -> np.ndarray:
        """Return psi(F), shape (...,) [J/m^3]."""
        lam, mu = self.linear.lame
        log_J = np.log(determinant(F))
        squared = np.einsum("...ij,...ij->...", F, F)
        return 0.5 * mu * (squared - 3.0) - mu * log_J + 0.5 * lam * log_J**2

    def stress(self, F: np.ndarray) -> np.ndarray:
        """Return P = mu (F - F^-T) + lambda ln J F^-T, shape (..., 3, 3) [Pa]."""
        lam, mu = self.linear.lame
        J = determinant(F)
        pressure = lam * np.log(J) - mu
        return mu * F + (pressure / J)[..., None, None] * cofactor(F)

    def tangent(self, F: np.ndarray) -> np.ndarray:
        """Return the derivative of the stress, H = F^-T, shape (..., 3, 3, 3, 3) [Pa].

        A_iJkL = mu d_ik d_JL + lambda H_iJ H_kL + (mu - lambda ln J) H_iL H_kJ
        """
        lam, mu = self.linear.lame
        J = determinant(F)
        H = cofactor(F) / J[..., None, None]
        shear = (mu - lam * np.log(J))[..., None, None, None, None]
        A = lam * _outer(H, H) + shear * _crossed(H, H)
        A += mu * np.einsum("ik,jl->ijkl", _IDENTITY, _IDENTITY)
        return A


def cofactor(F: np.ndarray) -> np.ndarray:
    """Return J F^-T, whose rows are the cross products of the other two rows; shape (..., 3, 3)."""
    a, b, c = F[..., 0, :], F[..., 1, :], F[..., 2, :]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)


def determinant(F: np.ndarray) -> np.ndarray:
    """Return J = det F, the ratio of volumes; shape (...,)."""
    a, b, c = F[..., 0, :], F[..., 1, :], F[..., 2, :]
    return np.einsum("...i,...i->...", a, np.cross(b, c))


def _green(F: np.ndarray) -> np.ndarray:
    return 0.5 * (np.swapaxes(F, -1, -2) @ F - _IDENTITY)


def _trace(E: np.ndarray) -> np.ndarray:
    return np.einsum("...ii->...", E)


def _outer(G: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Return G_iJ H_kL."""
    return np.einsum("...ij,...kl->...ijkl", G, H)


def _crossed(G: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Return G_iL H_kJ."""
    return np.einsum("...il,...kj->...ijkl", G, H)
