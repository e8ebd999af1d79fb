"""Choice of the kind of loads for a cloud, by their predictions of left-out patches."""

from __future__ import annotations

import numpy as np

from avatar_core.common.arrays import FloatArray, IntArray, farthest_points
from avatar_core.errors import RegistrationError
from avatar_core.geometry.point_location import closest_points
from avatar_core.registration.cloud import Cloud, require_on_organ, without_background
from avatar_core.registration.fit import Alternative, Fit, Problem, fit, rigid_motion
from avatar_core.registration.loads import Kind
from avatar_core.registration.rule import RegistrationRule
from avatar_core.vademecum.model import Vademecum

KINDS: tuple[Kind, ...] = ("smooth", "few")
_FOLDS = 4  # patches of a cloud, each left out once
_WORST = 0.01  # distance at which a point is as wrong as it can be [m]
_ALIKE = 2.0  # scores within this factor leave both kinds in question


def posed(
    vademecum: Vademecum, cloud: Cloud, rule: RegistrationRule
) -> tuple[Problem, tuple[str, ...]]:
    """Return the problem to be fitted, without background, and notices of points left out.

    Raises RegistrationError if the cloud cannot be one of this organ.
    """
    mesh = vademecum.mesh
    cloud = without_background(cloud, mesh.vertices, mesh.boundary_faces)
    require_on_organ(
        cloud, mesh.vertices, mesh.boundary_faces, lambda other: _off(vademecum, other, rule)
    )
    return Problem(vademecum, cloud.thinned(), rule), cloud.notices


def _off(vademecum: Vademecum, cloud: Cloud, rule: RegistrationRule) -> float:
    """Return the median distance of a cloud from the organ that was moved rigidly to it [m]."""
    motion, mesh = rigid_motion(vademecum, cloud, rule), vademecum.mesh
    points = motion.back(cloud.thinned())
    feet, _, _ = closest_points(mesh.vertices, mesh.boundary_faces, points)
    return float(np.median(np.linalg.norm(points - feet, axis=1)))


def chosen(problem: Problem) -> tuple[Fit, tuple[Alternative, ...]]:
    """Return the fit of the kind that is asked for, or of the kind that predicts best.

    Other kinds that predict the left-out points about as well are returned beside it, with their
    weights.
    """
    if problem.rule.kind is not None:
        return fit(problem, problem.rule.kind), ()
    scores = {kind: score(problem, kind) for kind in KINDS}
    best, other = sorted(KINDS, key=lambda kind: scores[kind])
    found = fit(problem, best)
    if scores[other] > _ALIKE * scores[best]:
        return found, ()
    likeness = (scores[best] / scores[other]) ** 4
    try:
        rival = fit(problem, other)
    except RegistrationError:
        return found, ()
    displacement = rival.loads.displacement(rival.coefficients)
    place = rival.motion(problem.vademecum.mesh.vertices + displacement)
    return found, (Alternative(likeness / (1.0 + likeness), displacement, place),)


def score(problem: Problem, kind: Kind) -> float:
    """Return the root mean square distance of points from their prediction by the others [m]."""
    patches, square = patches_of(problem.points), []
    for number in range(_FOLDS):
        left = patches == number
        try:
            found = fit(problem.with_points(problem.points[~left]), kind)
        except RegistrationError:
            return np.inf
        moved = found.loads.displacement(found.coefficients)[problem.on_surface]
        surface = found.motion(problem.vertices + moved)
        points = np.ascontiguousarray(problem.points[left])
        feet, _, _ = closest_points(surface, problem.faces, points)
        square.append(np.minimum(((points - feet) ** 2).sum(axis=1), _WORST**2))
    return float(np.sqrt(np.concatenate(square).mean()))


def patches_of(points: FloatArray) -> IntArray:
    """Return each point's patch, shape (n,): the nearest of points far from one another."""
    middles = points[farthest_points(points, _FOLDS + 1)[1:]]
    return np.asarray(np.linalg.norm(points[:, None] - middles[None], axis=2).argmin(axis=1))
