"""Registration of an organ to a cloud: displacement everywhere, with its uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.errors import RegistrationError
from avatar_core.fem.norms import mean_gradient, mean_strain
from avatar_core.geometry.point_location import target_carriers
from avatar_core.registration.choice import chosen, posed
from avatar_core.registration.cloud import Cloud
from avatar_core.registration.fit import Fit
from avatar_core.registration.rigid import RigidMotion
from avatar_core.registration.rule import RegistrationRule
from avatar_core.vademecum.model import Vademecum

# The true errors of synthetic clouds over the standard deviations that the posterior gives them:
# loads are no Gaussian field, supports move, meshes differ. `avatar study registration` measures
# the coverage.
UNDERSTATED = 1.5
# Relative error of small strains over the mean gradient of a displacement: point forces on a
# neo-Hookean organ, up to 60 mm (`avatar study registration`).
SMALL_STRAINS_OFF = 1.0
INTERVAL_90 = 1.645  # half of a 90 % interval, in standard deviations
_KEPT = 1e-4  # of the largest variance over the surface, below which directions are dropped
_EVERY = 7  # vertices of the surface by which directions are judged
_MOST_OUTLYING = 0.1
_MOST_NOISE = 2.0  # noise that is found over that expected
_MOST_MISMATCH = 0.6  # mismatch of the surface over the noise expected; others have 0.1 to 0.4
# Largest mean strain of a fitted deformation. Right answers have up to 0.07 at displacements of
# 20 mm. Loads that fit a cloud which no load caused have 0.3.
_MOST_STRAIN = 0.15
SEEN = 0.015  # largest distance of a seen vertex from the cloud [m]
_OUT_OF_SIGHT = 0.05  # distance beyond which the cloud does not reduce the model's error [m]
_MOST_HIDDEN = 0.1  # fraction of unseen vertices that may be undetermined in a good answer


@dataclass(frozen=True, eq=False)
class Estimate:
    """Present place of a point of the organ, or of the middle of some vertices.

    Attributes
    ----------
    name : str
        Name of the point.
    rest, place : ndarray, shape (3,)
        Place at rest, and present place in the cloud's frame [m].
    displacement : ndarray, shape (3,)
        Displacement by deformation, along the axes at rest [m].
    displacement_deviation, place_deviation : ndarray, shape (3,)
        Standard deviations along the axes [m].
    model_error : float
        Standard deviation of each from the vademecum's own error, part of both [m].
    """

    name: str
    rest: FloatArray
    place: FloatArray
    displacement: FloatArray
    displacement_deviation: FloatArray
    place_deviation: FloatArray
    model_error: float


@dataclass(frozen=True, eq=False)
class PlaceForce:
    """Force on a part of the surface: its middle (3,) [m] at rest, and a vector (3,) [N]."""

    point: FloatArray
    force: FloatArray


@dataclass(frozen=True, eq=False)
class Registered:
    """A vademecum registered to a cloud.

    Attributes
    ----------
    vademecum : Vademecum
        Vademecum that was registered.
    fit : Fit
        Its loads, motion and residuals.
    displacement : ndarray, shape (n_vertices, 3)
        Displacement by deformation, along the axes at rest [m].
    place : ndarray, shape (n_vertices, 3)
        Places of the vertices in the cloud's frame [m].
    displacement_spread, place_spread : ndarray, shape (n_vertices, 3, k)
        Square roots S of the posterior covariance of any vertices, S S^T [m].
    model_error : float
        Relative error by the vademecum's certificate and by small strains.
    away : ndarray, shape (n_vertices,)
        Distance of each place from the nearest point of the cloud [m].
    within : float
        Bound of the rule, within which a place is determined [m].
    problems : tuple[str, ...]
        Reasons why the model does not explain the cloud, one line each; empty if it does.
    notices : tuple[str, ...]
        Further notices, one line each.

    Examples
    --------
    >>> moved = v.mesh.vertices + v.displacement_at(point, 3.0)
    >>> seen = moved[np.unique(v.mesh.boundary_faces[v.regions.accessible])]
    >>> found = av.register(v, seen)
    >>> found.rms < 2e-3, found.target_at([0.0, 0.03, 0.0]).place.shape
    (True, (3,))
    """

    vademecum: Vademecum
    fit: Fit
    displacement: FloatArray
    place: FloatArray
    displacement_spread: FloatArray
    place_spread: FloatArray
    model_error: float
    away: FloatArray
    within: float
    problems: tuple[str, ...]
    notices: tuple[str, ...] = ()

    @property
    def motion(self) -> RigidMotion:
        """The rigid motion from the organ's frame to the cloud's."""
        return self.fit.motion

    @property
    def rms(self) -> float:
        """Root mean square distance of the cloud from the surface [m]."""
        return float(np.sqrt(np.mean(self.fit.residuals**2)))

    @property
    def displacement_deviation(self) -> FloatArray:
        """Standard deviations of displacement, model error included, (n_vertices, 3) [m]."""
        return self._deviation(self.displacement_spread)

    @property
    def place_deviation(self) -> FloatArray:
        """Standard deviations of the place in the cloud's frame, (n_vertices, 3) [m]."""
        return self._deviation(self.place_spread)

    @property
    def seen(self) -> FloatArray:
        """Mask of vertices less than 15 mm from a point of the cloud, shape (n_vertices,)."""
        return np.asarray(self.away < SEEN)

    @property
    def model_deviation(self) -> FloatArray:
        """Standard deviation along each axis by the model's own error, (n_vertices,) [m].

        A near cloud reduces it.
        """
        size = np.linalg.norm(self.displacement, axis=1)
        mean = float(np.sqrt(np.mean(size**2)))
        hidden = np.clip(self.away / _OUT_OF_SIGHT, 0.4, 1.0)
        return np.asarray(self.model_error * hidden * np.hypot(size, mean) / np.sqrt(6.0))

    @property
    def interval(self) -> FloatArray:
        """Half of the 90 % interval of the place along the axis where it is widest, (n,) [m]."""
        return np.asarray(INTERVAL_90 * self.place_deviation.max(axis=1))

    @property
    def is_determined(self) -> FloatArray:
        """Mask of vertices whose place is known within the bound, shape (n_vertices,)."""
        return np.asarray(self.interval <= self.within)

    @property
    def by_data(self) -> FloatArray:
        """Influence of the cloud, against the prior, on each place, 0 to 1, (n_vertices,) [-]."""
        variance = (self.place_spread**2).sum(axis=2).mean(axis=1) / UNDERSTATED**2
        return np.asarray(np.clip(1.0 - variance / self.fit.prior_deviation**2, 0.0, 1.0))

    def undetermined(self, estimates: Sequence[Estimate] = ()) -> tuple[str, ...]:
        """Return notices of undetermined places, one line each: the unseen part, and targets."""
        lines = []
        hidden = np.logical_not(self.seen)
        if (
            hidden.any()
            and (part := 1.0 - float(np.mean(self.is_determined[hidden]))) > _MOST_HIDDEN
        ):
            width = 1e3 * float(np.quantile(self.interval[hidden], 0.9))
            lines.append(
                f"{part:.0%} of what is not seen is not determined within {1e3 * self.within:.0f} "
                f"mm (+- {width:.0f} mm)"
            )
        for one in estimates:
            width = INTERVAL_90 * float(one.place_deviation.max())
            if width > self.within:
                lines.append(f"{one.name} is not determined (+- {1e3 * width:.0f} mm)")
        return tuple(lines)

    def _deviation(self, spread: FloatArray) -> FloatArray:
        square = (spread**2).sum(axis=2) + self.model_deviation[:, None] ** 2
        return np.asarray(np.sqrt(square))

    def estimate(self, name: str, vertices: IntArray, weights: FloatArray) -> Estimate:
        """Return the estimate for a weighted mean of vertices, whose weights sum to one.

        Parameters
        ----------
        vertices : ndarray of int, shape (n,)
        weights : ndarray, shape (n,)
        """
        own = float(weights @ self.model_deviation[vertices])

        def deviation(spread: FloatArray) -> FloatArray:
            mean = np.einsum("n,nak->ak", weights, spread[vertices])
            return np.asarray(np.sqrt((mean**2).sum(axis=1) + own**2))

        moved, place = weights @ self.displacement[vertices], weights @ self.place[vertices]
        return Estimate(
            name,
            self.motion.back(place[None])[0] - moved,
            place,
            moved,
            deviation(self.displacement_spread),
            deviation(self.place_spread),
            own,
        )

    def target_at(self, point: ArrayLike) -> Estimate:
        """Return the present place of a point of the organ.

        Parameters
        ----------
        point : array_like, shape (3,)
            Point of the organ at rest [m].

        Raises
        ------
        RegistrationError
            If the point is not finite or lies more than 5 mm outside the organ.
        """
        corners, weights = target_carriers(self.vademecum.mesh, point, RegistrationError)
        return self.estimate("target", corners, weights)

    def targets(self) -> list[Estimate]:
        """Return the present places of the middles of structures inside, e.g. tumours."""
        display, found = self.vademecum.display, []
        for name, faces in self.vademecum.structures.items():
            assert display is not None
            used = np.unique(faces)
            weights = np.asarray(display.weights[used], float).ravel() / len(used)
            found.append(self.estimate(name, display.corners[used].ravel(), weights))
        return found

    def largest(self) -> Estimate:
        """Return the present place of the vertex that the deformation displaces most."""
        vertex = int((self.displacement**2).sum(axis=1).argmax())
        return self.estimate("largest displacement", np.array([vertex]), np.ones(1))

    def strongest_forces(self, n: int = 3) -> tuple[PlaceForce, ...]:
        """Return forces within two patch radii of the places pressed or pulled hardest."""
        surface = self.vademecum.surface
        forces = self.fit.loads.at_positions(self.fit.coefficients)
        reach = 2.0 * surface.patch_radius
        apart = np.linalg.norm(surface.centers[:, None] - surface.centers[None], axis=2)
        sums = (apart < reach) @ forces
        strongest = surface.largest_apart(np.linalg.norm(sums, axis=1), n, 2.0 * reach)
        return tuple(PlaceForce(surface.centers[k], sums[k]) for k in strongest)


def register(
    vademecum: Vademecum, cloud: Cloud | ArrayLike, rule: RegistrationRule | None = None
) -> Registered:
    """Bring an organ to a cloud of points on its deformed surface.

    The response is linear, even for a vademecum with large deformation. Its error at large strains
    is part of the standard deviations.

    Parameters
    ----------
    cloud : Cloud or array_like, shape (n, 3)
        Points in any order [m], at least 50, aligned to about 10 mm and 10 degrees.
    rule : RegistrationRule, optional
        Prior knowledge of noise, motion and loads.

    Returns
    -------
    Registered

    Raises
    ------
    RegistrationError
        If the cloud cannot be one of this organ.

    Examples
    --------
    >>> moved = v.mesh.vertices + v.displacement_at(point, 3.0)
    >>> seen = moved[np.unique(v.mesh.boundary_faces[v.regions.accessible])]
    >>> found = av.register(v, seen, av.RegistrationRule(turn=0.0, shift=0.0))
    >>> np.abs(found.place - moved).max() < 5e-3, found.interval.shape == (len(moved),)
    (True, True)
    """
    rule = rule or RegistrationRule()
    cloud = cloud if isinstance(cloud, Cloud) else Cloud(np.asarray(cloud, float))
    problem, notices = posed(vademecum, cloud, rule)
    found, rival = chosen(problem)
    n, motion, mesh = found.loads.size, found.motion, vademecum.mesh
    roots = UNDERSTATED * _roots(vademecum, found)
    displacement = found.loads.displacement(found.coefficients)
    place = motion(mesh.vertices + displacement)
    spread = (found.loads.columns.reshape(-1, n) @ roots[:n]).reshape(*displacement.shape, -1)
    turned = np.einsum("ab,nbk->nak", motion.matrix, spread)
    arms = place - motion.centre - motion.shift
    turned += np.cross(roots[n : n + 3].T[None], arms[:, None], axis=2).swapaxes(1, 2)
    turned += roots[n + 3 :]
    for one in (*found.alternatives, *rival):
        root = np.sqrt(one.weight)
        spread = _beside(spread, root * (one.displacement - displacement))
        turned = _beside(turned, root * (one.place - place))
    certificate = vademecum.certificate
    error = 0.0 if certificate is None else float(np.nan_to_num(certificate.l2_mean))
    error = float(np.hypot(error, SMALL_STRAINS_OFF * mean_gradient(mesh, displacement)))
    apart = np.linalg.norm(place[:, None] - cloud_part(problem.points)[None], axis=2).min(axis=1)
    return Registered(
        vademecum,
        found,
        displacement,
        place,
        spread,
        turned,
        error,
        apart,
        rule.within,
        _problems(found, rule, mean_strain(mesh, displacement)),
        notices,
    )


def _beside(spread: FloatArray, column: FloatArray) -> FloatArray:
    return np.concatenate([spread, column[:, :, None]], axis=2)


def cloud_part(points: FloatArray) -> FloatArray:
    """Return some 500 points of a cloud, by which distances to it are judged."""
    return points[:: max(1, len(points) // 500)]


def _roots(vademecum: Vademecum, found: Fit) -> FloatArray:
    """Return R with R R^T ~ the covariance, shape (n + 6, k), for what moves the surface alone."""
    size = np.sqrt(np.maximum(np.diagonal(found.covariance), np.finfo(float).tiny))
    value, vector = np.linalg.eigh(found.covariance / np.outer(size, size))  # alike in unit
    half = size[:, None] * vector * np.sqrt(np.maximum(value, 0.0))
    some = vademecum.mesh.surface_vertices[::_EVERY]
    n = found.loads.size
    moved = found.loads.columns[some] @ half[:n]
    arms = vademecum.mesh.vertices[some] - found.motion.centre
    moved += np.cross(half[n : n + 3].T[None], arms[:, None], axis=2).swapaxes(1, 2)
    moved += half[n + 3 :]
    flat = moved.reshape(-1, moved.shape[2])
    value, vector = np.linalg.eigh(flat.T @ flat)
    return np.asarray(half @ vector[:, value > _KEPT * value[-1]])


def _problems(found: Fit, rule: RegistrationRule, strain: float) -> tuple[str, ...]:
    """Return reasons why loads, rigid motion and noise do not explain the cloud."""
    noise, mismatch = found.scales[2], found.scales[3]
    problems = []
    if not found.converged:
        problems.append(f"the iteration had not ended after {found.n_steps} steps")
    if noise > _MOST_NOISE * rule.noise:
        problems.append(
            f"the points scatter by {1e3 * noise:.1f} mm, not the {1e3 * rule.noise:.1f} mm "
            "expected (--noise)"
        )
    if mismatch > (_MOST_NOISE if rule.correlation else _MOST_MISMATCH) * rule.noise:
        problems.append(
            f"neighboring points lie off the surface together, by {1e3 * mismatch:.1f} mm"
        )
    if strain > _MOST_STRAIN:
        problems.append(
            f"the organ would be strained by {strain:.0%} on average, which small strains do not "
            "hold: something deforms it that the vademecum does not know"
        )
    if found.outlying > _MOST_OUTLYING:
        problems.append(f"{found.outlying:.0%} of the points are far off the surface")
    return tuple(problems)
