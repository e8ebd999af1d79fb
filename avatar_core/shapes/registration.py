"""Elastic registration of a template liver to another one: the same mesh with moved vertices.

    min over x of  stiffness W(x) + 1/2 sum_i w_i |x_i - c_i|^2 + 1/2 sum_j w_j |p_j - q_j|^2

W is the distortion of the tetrahedra against the aligned template. c_i is the point of the target
nearest to surface vertex i, and p_j(x) the point of the template's surface nearest to target sample
q_j. Distances count along the surface normal, and in both directions, so that thin lobes are
filled. In the last stages, samples that are not reached pull the template straight to them. Springs
along the normals of a tip's two faces would not lengthen the tip. The stiffness falls stage by
stage. W is infinite on a flat tetrahedron and every step lowers the sum, so that no tetrahedron
inverts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import rslab
from scipy.spatial.transform import Rotation

from avatar_core.common.arrays import FloatArray
from avatar_core.errors import RegistrationError
from avatar_core.geometry.mesh import (
    MeshQuality,
    Regions,
    TetMesh,
    quality,
    regions_by_rule,
    tetrahedralize,
)
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.distortion import Distortion
from avatar_core.shapes.springs import Target, sample_target, surface_springs

PLAUSIBLE_SCALE = (0.5, 2.0)  # scale of livers against the template, measured 0.82 to 1.27


@dataclass(frozen=True)
class Template:
    """The liver to which all others are registered.

    Attributes
    ----------
    name : str
        Name of the organ it was made from.
    regions : Regions
        Clamp and accessible faces over ``mesh.boundary_faces``.

    Examples
    --------
    >>> av.shapes.Template.of(liver, n_vertices=300).name
    'phantom'
    """

    name: str
    mesh: TetMesh
    regions: Regions

    @classmethod
    def of(cls, surface: SurfaceMesh, n_vertices: int = 2850) -> Template:
        """Make a template of an organ's surface, with clamp and access by the anatomical rule."""
        mesh = tetrahedralize(surface, n_vertices)
        return cls(surface.name, mesh, regions_by_rule(mesh))


@dataclass(frozen=True)
class TemplateRule:
    """Stiffnesses, number of steps and tolerances of a registration.

    Attributes
    ----------
    first_stiffness, last_stiffness : float
        Stiffness of the distortion against the distances in the first and the last stage. Both
        terms are dimensionless by the cube root of the target's volume.
    n_stages, sweeps : int
        Number of stages, over which the stiffness falls by equal factors, and of steps in each.
    last_sweeps : int
        Largest number of further steps in the last stage, until the tolerance and the reach are
        met.
    tolerance : float
        Mean node-to-surface distance at which the registration has converged [m].
    reach : float
        Distance from a target sample beyond which the template is pulled straight to it [m].
    largest_mean, largest_reverse_mean : float
        Mean distances beyond which a registration has failed: from the template's vertices to the
        target, and from the target to the template's faces [m].
    least_jacobian : float
        Volume of a tetrahedron over its aligned one below which it has failed.
    largest_distortion : float
        W above which the target is not of the template's kind; 64 livers measure 0.21 to 0.85, a
        torus 2.4.
    n_samples : int
        Number of springs from the target; three times as many samples are searched for the nearest.
    normal_length : float
        Distance that a normal turned by one radian counts as [m].
    tangential : float
        Stiffness of springs along the surface over that across it in the first stage; falls to 0.
    exact_stiffness : float
        Stiffness below which the nearest point is sought on the target's triangles.
    rotation_spread : float
        Standard deviation of the rotation between patients lying alike [deg].

    Examples
    --------
    >>> av.shapes.TemplateRule(tolerance=0.5e-3).n_stages
    14
    """

    first_stiffness: float = 1.0
    last_stiffness: float = 2e-4
    n_stages: int = 14
    sweeps: int = 1
    last_sweeps: int = 8
    tolerance: float = 0.3e-3
    reach: float = 4e-3
    largest_mean: float = 0.5e-3
    largest_reverse_mean: float = 2.5e-3
    least_jacobian: float = 0.01
    largest_distortion: float = 1.3
    n_samples: int = 4000
    normal_length: float = 0.03
    tangential: float = 0.1
    exact_stiffness: float = 2e-3
    rotation_spread: float = 10.0

    @property
    def stiffnesses(self) -> FloatArray:
        """Stiffness of each step, descending."""
        stages = np.geomspace(self.first_stiffness, self.last_stiffness, self.n_stages)
        last = np.full(self.last_sweeps, self.last_stiffness)
        return np.concatenate([np.repeat(stages, self.sweeps), last])


@dataclass(frozen=True)
class RegistrationStep:
    """One step of the continuation.

    Attributes
    ----------
    stiffness : float
        Stiffness of the stage.
    objective : float
        Objective after the step, with the springs of the step.
    length : float
        Fraction of the Newton step taken; 0 if no step lowered the objective.
    mean_distance : float
        Mean distance of the surface vertices to the target [m].
    least_jacobian : float
        Smallest volume of a tetrahedron over its aligned one.
    """

    stiffness: float
    objective: float
    length: float
    mean_distance: float
    least_jacobian: float


@dataclass(frozen=True)
class SimilarityTransform:
    """Similarity x' = scale rotation x + translation, from the template to the target."""

    scale: float
    rotation: FloatArray
    translation: FloatArray

    def __call__(self, points: FloatArray) -> FloatArray:
        """Move points, shape (k, 3) [m]."""
        return self.scale * points @ self.rotation.T + self.translation

    def back(self, points: FloatArray) -> FloatArray:
        """Move points, shape (k, 3) [m], from the target to the template."""
        return (points - self.translation) @ self.rotation / self.scale

    @property
    def angle(self) -> float:
        """Angle of the rotation [deg]."""
        return float(np.degrees(Rotation.from_matrix(self.rotation).magnitude()))


@dataclass(frozen=True)
class RegistrationQuality:
    """Distances of a registered template from its target, and the state of its tetrahedra.

    Attributes
    ----------
    mean_distance, max_distance : float
        Distances of surface vertices to the target [m].
    reverse_mean_distance, reverse_max_distance : float
        Distances of target samples to the registered faces [m].
    least_jacobian : float
        Smallest volume of a tetrahedron over its aligned one.
    distortion : float
        W, 0 for a similarity.
    shape : MeshQuality
        Quality of the registered mesh.
    """

    mean_distance: float
    max_distance: float
    reverse_mean_distance: float
    reverse_max_distance: float
    least_jacobian: float
    distortion: float
    shape: MeshQuality


@dataclass(frozen=True)
class Registration:
    """A template registered to a target.

    Attributes
    ----------
    mesh : TetMesh
        The template's tetrahedra with moved vertices.
    alignment : SimilarityTransform
        Similarity from which the elastic registration started.
    history : tuple[RegistrationStep, ...]
        One entry per step.
    converged : bool
        Whether the alignment converged and the tolerance was met. If not, the result is still
        within the larger distances of the rule.

    Examples
    --------
    >>> template = av.shapes.Template.of(liver, 300)
    >>> found = av.shapes.register_template(template, liver, rough)
    >>> found.mesh.tets is template.mesh.tets
    True
    """

    template: Template
    mesh: TetMesh
    alignment: SimilarityTransform
    quality: RegistrationQuality
    history: tuple[RegistrationStep, ...]
    converged: bool

    @property
    def notices(self) -> tuple[str, ...]:
        """One line if it did not converge."""
        return () if self.converged else (not_converged(self.quality),)


def not_converged(quality: RegistrationQuality) -> str:
    """Return the notice of a registration that is used although it did not converge."""
    return (
        f"registration not converged: {quality.mean_distance * 1000.0:.2g} mm mean distance "
        "from the surface; check the regions, or register from a liver more like it"
    )


def register_template(
    template: Template, surface: SurfaceMesh, rule: TemplateRule | None = None
) -> Registration:
    """Register the template to a surface: align it, then soften it until its vertices lie on it.

    Raises
    ------
    RegistrationError
        If the target is not an organ of the template's kind: its size differs too much, or
        tetrahedra would flatten before its surface is reached.

    Examples
    --------
    >>> (change,) = av.shapes.population(1, seed=0)
    >>> template = av.shapes.Template.of(liver, 300)
    >>> found = av.shapes.register_template(template, change.moved(liver), rough)
    >>> found.quality.mean_distance < 2e-3  # [m]
    True
    """
    rule = rule or TemplateRule()
    target = sample_target(surface, 3 * rule.n_samples)
    alignment, aligned_converged = align_upright(template.mesh, target, rule)
    aligned = alignment(template.mesh.vertices)
    fit = _Fit(Distortion(aligned, template.mesh.tets), template.mesh, target, rule)
    positions, history = aligned, []
    for stiffness in rule.stiffnesses:
        positions, step = fit.step(positions, float(stiffness))
        history.append(step)
        if step.mean_distance <= rule.tolerance and fit.missed(positions) <= rule.reach:
            break
    reached = measure(fit.distortion, template.mesh, positions, target)
    _require_close(reached, surface.name, rule)
    mesh = TetMesh(positions, template.mesh.tets)
    converged = aligned_converged and reached.mean_distance <= rule.tolerance
    return Registration(template, mesh, alignment, reached, tuple(history), converged)


def _require_close(reached: RegistrationQuality, name: str, rule: TemplateRule) -> None:
    """Raise RegistrationError, which names each criterion that is not met."""
    failures = []
    if not reached.mean_distance <= rule.largest_mean:
        failures.append(f"its vertices stay {reached.mean_distance * 1e3:.2g} mm off")
    if not reached.reverse_mean_distance <= rule.largest_reverse_mean:
        failures.append(f"it leaves {reached.reverse_mean_distance * 1e3:.2g} mm uncovered")
    if not reached.least_jacobian >= rule.least_jacobian:
        failures.append(f"an element shrinks to {reached.least_jacobian:.1e} of its volume")
    if not reached.distortion <= rule.largest_distortion:
        failures.append(f"it is bent out of shape, distortion {reached.distortion:.2g}")
    if failures:
        raise RegistrationError(
            f"{name}: the template does not fit ({', '.join(failures)}); check that this is one "
            "whole liver with the right --axes, or register from a liver more like it"
        )


# --- steps ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Fit:
    """Problem of each step of the continuation."""

    distortion: Distortion
    mesh: TetMesh
    target: Target
    rule: TemplateRule

    def step(self, x: FloatArray, stiffness: float) -> tuple[FloatArray, RegistrationStep]:
        """Update the springs, then take a Newton step with Armijo's line search."""
        exact, length = stiffness < self.rule.exact_stiffness, self.rule.normal_length
        springs = surface_springs(x, self.mesh, self.target, None if exact else length)
        springs = springs.straightened(x, self.rule.reach) if exact else springs
        size = self.target.volume ** (1.0 / 3.0)
        springs = replace(springs, weights=springs.weights / size**2)
        A, b = springs.system(len(x), 0.0 if exact else self._tangential(stiffness))

        def objective(y: FloatArray) -> float:
            return stiffness * self.distortion.energy(y) + 0.5 * float(
                np.sum((A @ y.ravel() - b) ** 2)
            )

        slope, curvature = self.distortion.derivatives(x)
        gradient = stiffness * slope + A.T @ (A @ x.ravel() - b)
        hessian = stiffness * curvature
        self.distortion.add(hessian, (A.T @ A).tocsr())
        direction = -self._analysis.factor(hessian).solve(gradient)
        x, value, length = line_search(objective, x, direction, float(gradient @ direction))
        distance, _ = self.target.closest(x[self.mesh.surface_vertices])
        jacobian = float(self.distortion.jacobians(x).min())
        return x, RegistrationStep(stiffness, value, length, float(distance.mean()), jacobian)

    def missed(self, x: FloatArray) -> float:
        """Return the largest distance of a target sample from the template [m]."""
        return float(self.target.distance_to(x, self.mesh.boundary_faces).max())

    @cached_property
    def _analysis(self) -> rslab.LdltSymbolic:
        """Symbolic factorization of the common pattern of all Hessians."""
        pattern = self.distortion.matrix(np.ones(self.distortion.n_entries))
        return rslab.analyze(pattern, path="ldlt", threads=1)

    def _tangential(self, stiffness: float) -> float:
        """Return the tangential stiffness, which falls in the logarithm of the stage's stiffness.

        It is the rule's value in the first stage and 0 in the last.
        """
        rule = self.rule
        passed = np.log(stiffness / rule.first_stiffness)
        return rule.tangential * (
            1.0 - float(passed / np.log(rule.last_stiffness / rule.first_stiffness))
        )


def line_search(
    objective: Callable[[FloatArray], float], x: FloatArray, direction: FloatArray, slope: float
) -> tuple[FloatArray, float, float]:
    """Halve the step until it lowers the objective; x and length 0 if none of 20 does."""
    start, change, length = objective(x), direction.reshape(-1, 3), 1.0
    for _ in range(20):
        value = objective(x + length * change)
        if value <= start + 1e-4 * length * slope:
            return x + length * change, value, length
        length /= 2.0
    return x, start, 0.0


def measure(
    distortion: Distortion, mesh: TetMesh, positions: FloatArray, target: Target
) -> RegistrationQuality:
    """Return the distances in both directions, and the state of the tetrahedra."""
    distance, _ = target.closest(positions[mesh.surface_vertices])
    reverse = target.distance_to(positions, mesh.boundary_faces)
    return RegistrationQuality(
        float(distance.mean()),
        float(distance.max()),
        float(reverse.mean()),
        float(reverse.max()),
        float(distortion.jacobians(positions).min()),
        distortion.energy(positions),
        quality(TetMesh(positions, mesh.tets)),
    )


# --- alignment --------------------------------------------------------------------------------


def align_upright(
    mesh: TetMesh, target: Target, rule: TemplateRule, iterations: int = 60
) -> tuple[SimilarityTransform, bool]:
    """Return the similarity from template to target near the axes of both, and if it converged.

    Gauss-Newton minimises the squared distances of both surfaces, from matched volume and centroid,
    plus |rotation|^2 / rotation_spread^2. Without that prior, the closest fit of two roundish
    organs can lie 65 degrees off, and maps one anatomical region to another. The alignment of 42
    livers took 3 to 8 steps.

    Raises
    ------
    RegistrationError
        If the scale leaves 0.5 to 2.
    """
    scale = (target.volume / mesh.volume) ** (1.0 / 3.0)
    center = mesh.centroid
    _require_scale(scale, target.surface.name)
    turn, shift = np.eye(3), target.center
    prior = _PRIOR_DISTANCE / np.radians(rule.rotation_spread)
    for _ in range(iterations):
        arm = scale * (mesh.vertices - center) @ turn.T
        springs = surface_springs(arm + shift, mesh, target, rule.normal_length)
        point, normal = springs.points(arm), springs.normals
        columns = [np.cross(point, normal), np.sum(point * normal, axis=1)[:, None], normal]
        gap = np.sum((springs.anchors - point - shift) * normal, axis=1)
        root = np.sqrt(springs.weights)
        known = np.hstack([prior * np.eye(3), np.zeros((3, 4))])
        slope = np.vstack([np.hstack(columns) * root[:, None], known])
        right = np.concatenate([gap * root, -prior * Rotation.from_matrix(turn).as_rotvec()])
        change = np.linalg.lstsq(slope, right, rcond=None)[0]
        turn = Rotation.from_rotvec(change[:3]).as_matrix() @ turn
        scale, shift = scale * float(np.exp(change[3])), shift + change[4:]
        _require_scale(scale, target.surface.name)
        if converged := bool(np.abs(change[4:]).max() < 2e-4 and np.abs(change[:4]).max() < 2e-3):
            break
    return SimilarityTransform(scale, turn, shift - scale * turn @ center), converged


# a rotation by one spread costs as much as this root mean square distance [m]
_PRIOR_DISTANCE = 5e-3


def _require_scale(scale: float, name: str) -> None:
    low, high = PLAUSIBLE_SCALE
    if not low <= scale <= high:
        raise RegistrationError(
            f"{name}: {scale:.2g} times the template's size, expected {low} to {high}; check the "
            "unit (--unit) and that the surface is one whole liver"
        )
