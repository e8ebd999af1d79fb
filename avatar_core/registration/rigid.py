"""Small rigid motions about a fixed centre, x' = c + R (x - c) + t."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from avatar_core.common.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """Rotation by a vector about a centre, then a translation.

    Attributes
    ----------
    centre : ndarray, shape (3,)
        Centre [m].
    turn : ndarray, shape (3,)
        Rotation vector [rad].
    shift : ndarray, shape (3,)
        Translation [m].
    """

    centre: FloatArray
    turn: FloatArray = field(default_factory=lambda: np.zeros(3))
    shift: FloatArray = field(default_factory=lambda: np.zeros(3))

    @property
    def matrix(self) -> FloatArray:
        """Rotation matrix R, shape (3, 3)."""
        return np.asarray(Rotation.from_rotvec(self.turn).as_matrix())

    @property
    def angle(self) -> float:
        """Angle of the rotation [degrees]."""
        return float(np.degrees(np.linalg.norm(self.turn)))

    def __call__(self, points: FloatArray) -> FloatArray:
        """Move points, shape (n, 3) [m]."""
        moved = self.centre + (points - self.centre) @ self.matrix.T + self.shift
        return np.asarray(moved)

    def back(self, points: FloatArray) -> FloatArray:
        """Return the inverse motion of points, shape (n, 3) [m]."""
        return np.asarray(self.centre + (points - self.shift - self.centre) @ self.matrix)

    def with_unknowns(self, unknowns: FloatArray) -> RigidMotion:
        """Return another motion about the same centre."""
        return RigidMotion(self.centre, unknowns[:3], unknowns[3:])

    def rows(self, points: FloatArray, normals: FloatArray) -> FloatArray:
        """Return the derivatives of moved points along normals by the unknowns, shape (n, 6).

        They are exact to first order in a change of the turn about the same axis.
        """
        arms = points - self.centre - self.shift
        return np.hstack([np.cross(arms, normals), normals])
