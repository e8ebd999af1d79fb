"""A coarse surface shown finely around the dents of tips, for pictures; nothing here is felt.

The edges of an organ's mesh are some 9 mm long, a tip's dent a few. Triangles with a corner within
two patch radii of the tip are split twice, each into four. With D = u_tip - u_patch faded as in
:mod:`avatar_core.tips.dent`, what is left of a cloud's displacement without it is smooth:

    u(x) = I[u + n D](x) - n D(rho(x)),

I being linear interpolation on the coarse triangles. At the cloud's own points that is the cloud.
Of several tips, the D add up.

A cloud does not say what made its dent; it is found again from the tip's depth d on the linear
organ at rest, delta + F (gamma - c) = d, gamma the compliance for the patch. That holds for any
Young's modulus and in tissue that relaxes. The local shape of the surface, other tools and large
deformation are left out of D, of which only what is not linear between the cloud's points shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.optimize import brentq

from avatar_core.common.splines import evaluate
from avatar_core.errors import AvatarError
from avatar_core.fem.patch_on_plane import patch_dent, quarter_turn
from avatar_core.geometry.tip import Tip
from avatar_core.tips.dent import FADE, REACH
from avatar_core.tips.law import PATCH_ON_MESH
from avatar_core.vademecum.model import Vademecum

_LEVELS = 2  # of splitting
_NODES = 12  # of Gauss's rule
_WIDEST = 0.995  # contact radius over a sphere's, whose profile has no depth at its equator
_ON_GRID = 1e3  # distance off the grid of the tip field [m]


class FineSurface(NamedTuple):
    """Triangles to draw.

    positions : ndarray, shape (n, 3), deformed, those of the cloud first [m]
    displacements : ndarray, shape (n, 3) [m]
    faces : ndarray of int, shape (m, 3)
    parents : ndarray of int, shape (m,), the face of the organ that each is a part of
    """

    positions: np.ndarray
    displacements: np.ndarray
    faces: np.ndarray
    parents: np.ndarray


class Touch(NamedTuple):
    """How a tip presses.

    point, normal : ndarray, shape (3,), under the tip, at rest [m]
    radius : of the contact [m]
    wall : depth beyond that at which the whole tip touches [m]
    """

    point: np.ndarray
    normal: np.ndarray
    radius: float
    wall: float


def fine_surface(
    vademecum: Vademecum, points: np.ndarray, tips: Sequence[Tip], poses: np.ndarray
) -> FineSurface:
    """The surface of an organ under a cloud, split around tips that press, if it is coarse.

    The points of the cloud stay the first, those of structures inside among them.

    Parameters
    ----------
    points : ndarray, shape (n_surface_vertices, 6), deformed positions and displacements [m]
    tips : that press
    poses : ndarray, shape (n_tips, 3), of the tips, in the frame of the positions [m]
    """
    rest, faces = vademecum.surface_vertices, vademecum.organ_faces
    points = np.asarray(points, float)
    moved = points[:, 3:]
    breath = points[0, :3] - rest[0] - moved[0]  # of an organ whose frame moves
    found = (
        (tip, find_touch(vademecum, tip, pose - breath))
        for tip, pose in zip(tips, poses, strict=True)
    )
    touches = [(tip, touch) for tip, touch in found if touch is not None]
    is_fine = len(faces) > len(vademecum.mesh.boundary_faces)
    if not touches or is_fine:
        return FineSurface(points[:, :3], moved, faces, np.arange(len(faces)))
    patch_radius = vademecum.surface.patch_radius
    near = np.zeros(len(rest), bool)
    for _, touch in touches:
        near |= np.linalg.norm(rest - touch.point, axis=1) < REACH * patch_radius
    split = near[faces].any(axis=1)
    blend, finer = _split(faces[split], len(rest))
    places = blend @ rest
    changes = [
        _change(tip, touch, patch_radius, places)[:, None] * touch.normal for tip, touch in touches
    ]
    change = np.sum(changes, axis=0)
    displacements = blend @ (moved + change[: len(rest)]) - change
    displacements[: len(rest)] = moved  # to the bit
    positions = places + breath + displacements
    positions[: len(rest)] = points[:, :3]
    parents = [np.flatnonzero(~split), np.tile(np.flatnonzero(split), 4**_LEVELS)]
    return FineSurface(
        positions, displacements, np.concatenate([faces[~split], finer]), np.concatenate(parents)
    )


def find_touch(vademecum: Vademecum, tip: Tip, pose: np.ndarray) -> Touch | None:
    """The contact of a tip, in the organ's frame; None where it does not press, and for a patch."""
    field, gradient = vademecum.tip_field, np.zeros(3)
    phi = evaluate(field.distance, field.origin, field.spacing[0], pose, gradient, _ON_GRID)
    if not phi < tip.offset or tip.shape == "patch":
        return None
    normal = gradient / max(float(np.linalg.norm(gradient)), 1e-3)
    point = pose - phi * normal
    try:
        compliance = float(normal @ vademecum.compliance_at(point) @ normal)
    except AvatarError:  # off the accessible surface
        return None
    stiffness = vademecum.material.plane_strain_modulus
    taken = min(PATCH_ON_MESH / vademecum.surface.patch_radius, stiffness * compliance)
    depth, rest = tip.offset - phi, stiffness * compliance - taken
    most = 1.0 + depth / tip.radius

    def excess(part: float) -> float:
        delta, _, spring = _springs(tip, *_at(tip, part))
        return float(delta + np.pi * spring.sum() * rest - depth)

    return Touch(point, normal, *_at(tip, float(brentq(excess, 0.0, most, xtol=1e-6))))


def _at(tip: Tip, part: float) -> tuple[float, float]:
    """Contact radius and depth beyond it [m]; the whole tip touches from part 1 on."""
    widest = _WIDEST * tip.radius if tip.shape == "sphere" else tip.radius
    return min(part, 1.0) * widest, max(part - 1.0, 0.0) * tip.radius


def _springs(tip: Tip, a: float, wall: float) -> tuple[float, np.ndarray, np.ndarray]:
    """delta [m], x^2 [m^2] and 2 / pi w(x) dx [m^2] of a contact on a half-space."""
    theta, weight = quarter_turn(_NODES)
    x = a * np.sin(theta)
    delta = float(tip.depth(np.array(a))) + wall
    spring = 2.0 / np.pi * weight * a * np.cos(theta) * (delta - tip.depth(x))
    return delta, x**2, spring


def _change(tip: Tip, touch: Touch, patch_radius: float, places: np.ndarray) -> np.ndarray:
    """D at some places, shape (n,) [m]."""
    rho = np.linalg.norm(places - touch.point, axis=1)
    change, (near,) = np.zeros(len(rho)), np.nonzero(rho < REACH * patch_radius)
    rho = rho[near]
    delta, square, spring = _springs(tip, touch.radius, touch.wall)
    outside = np.maximum(rho, 1.000001 * touch.radius)[:, None] ** 2
    own = (spring / np.sqrt(outside - square)).sum(axis=1)
    inside = rho < touch.radius
    own[inside] = delta - tip.height(rho[inside])
    taken = np.pi * spring.sum() / patch_radius * patch_dent(rho / patch_radius)
    part = (rho / (REACH * patch_radius)) ** 2
    left = np.minimum(1.0, (1.0 - part) / (1.0 - (FADE / REACH) ** 2))
    change[near] = left**2 * (3.0 - 2.0 * left) * (own - taken)
    return change


def _split(faces: np.ndarray, n: int) -> tuple[sp.csr_matrix, np.ndarray]:
    """Each face into 4^_LEVELS: all vertices, the ``n`` old ones first, as sums of these; faces."""
    blend, faces = sp.identity(n, format="csr"), faces.astype(np.int64)
    for _ in range(_LEVELS):
        count = blend.shape[0]
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
        key, number = np.unique(edges @ np.array([count, 1]), return_inverse=True)
        middle = 0.5 * (blend[key // count] + blend[key % count])
        blend = sp.vstack([blend, middle], format="csr")
        (a, b, c), (ab, bc, ca) = faces.T, count + number.reshape(-1, 3).T
        corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = np.concatenate([np.stack(corner, axis=1) for corner in corners])
    return blend, faces
