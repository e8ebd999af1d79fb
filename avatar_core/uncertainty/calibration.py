"""Posterior of the material's values, from the measured forces of some touches.

Each parameter p_k is a function of a standard normal number z_k by its prior,

    p_k = Q_k(Phi(z_k)),

Q_k its quantile function. With y the logarithms of the measured forces and f those of the computed
ones, the most probable values minimize

    (y - f(z))^T C^-1 (y - f(z)) + z^T z.

The inverse of J^T C^-1 J + 1 there, J = df/dz, is the covariance of z (Tarantola, Inverse Problem
Theory, SIAM 2005, section 3.2).

C holds the errors of a force, each with its own reach:

    a sample   the sensor: a part of the force, and a smallest force
    a touch    the vademecum's own error at that place, and by how much the surface lies deeper or
               higher than in the model, times d ln F / d depth
    all        the mesh that all forces share

The covariance also contains the mesh error, which the forces cannot reveal. A tumour's contrast and
a support's stiffness are found for the mesh's version of their bodies. On three meshes of one organ
they came out up to a quarter off, on each to one side, however many the touches.

The vademecum's error has long tails: at few places it is many times its usual size. It is taken for
Student's t with nu degrees of freedom. The variance of a touch that is d deviations off is
multiplied by (nu + d^2) / (nu + 1) (Lange, Little & Taylor, J. Am. Stat. Assoc. 84:881, 1989).
These d also decide whether the model can have made the forces at all; see
:mod:`avatar_core.uncertainty.fit_check`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares
from scipy.special import ndtr

from avatar_core.common.arrays import FloatArray
from avatar_core.contact.layout import Shape, lay_out
from avatar_core.contact.model import ContactModel, Status, estimate_error, step
from avatar_core.errors import AvatarError, ContactError
from avatar_core.geometry.tip import Tip
from avatar_core.uncertainty.distributions import Distribution, Fixed, Lognormal
from avatar_core.uncertainty.fit_check import chance
from avatar_core.uncertainty.known import priors_of
from avatar_core.uncertainty.material_grid import MaterialGrid
from avatar_core.uncertainty.palpation import Palpation, palpation_of
from avatar_core.vademecum.accuracy import Detail
from avatar_core.vademecum.model import Vademecum

LEAST_PROBABILITY = 0.01  # probability of a fit below which the model is called wrong
MOST_RMS = 0.25  # misfit of ln F above which no fit is good; surfaces 0.3 mm off give 0.16
NINETY = 1.6449  # deviations from the middle that hold 90 % of a normal distribution
_N_WEIGHTINGS = 4  # by the forces that the last one expects
_FARTHEST = 4.0  # deviations of the tried values from the prior
_UNKNOWN = 0.1  # error of a force whose place was never certified
_LEAST_TOUCHES = 3
_N_DRAWS = 1000  # of the posterior, for notices
_STEP, _FLAT = 0.05, 1e-6  # step of a standard normal number; least d ln p / dz
_TAIL = 4.0  # degrees of freedom of a vademecum's error over the stated one


@dataclass(frozen=True)
class TouchErrors:
    """Standard deviations of the errors of a force.

    Attributes
    ----------
    sensor : float
        Sensor's error, relative to the force of each sample.
    least : float
        Least standard deviation of each sample [N].
    depth : float
        Depth of the surface's place at a touch [m].
    mesh : float
        Error of the mesh relative to the force, the same for all samples.
    extent : float
        Error of the mesh for the extent of a tumour or support, relative to contrast or stiffness.

    Raises
    ------
    AvatarError
        For a negative number or NaN, or if both errors of the sensor are 0.

    Examples
    --------
    >>> av.uncertainty.TouchErrors(sensor=0.05).depth  # [m]
    0.0003
    """

    sensor: float = 0.02
    least: float = 0.02
    depth: float = 0.3e-3
    mesh: float = 0.045
    extent: float = 0.2

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if not 0.0 <= value < np.inf:
                raise AvatarError(f"the error {one.name} is {value:g}; give 0 or a positive number")
        if self.sensor == self.least == 0.0:
            raise AvatarError("the errors sensor and least are both 0; give one, e.g. sensor=0.02")


@dataclass(frozen=True, eq=False)
class TouchTable:
    """Forces at the samples of a palpation, at the points of a grid of materials.

    Attributes
    ----------
    palpation : Palpation
        Touches that meet the organ in the vademecum.
    left_out : int
        Number of touches that miss it.
    log_force : ndarray, shape (n_points, n_samples)
        Logarithm of the force [N].
    steepness : ndarray, shape (n_samples,)
        d ln F / d depth [1/m].
    error : ndarray, shape (n_samples,)
        Standard deviation of the vademecum's own error, relative to the force.
    """

    grid: MaterialGrid
    palpation: Palpation
    left_out: int
    log_force: FloatArray
    steepness: FloatArray
    error: FloatArray

    def at(self, values: Mapping[str, FloatArray]) -> FloatArray:
        """Return ln of the forces at values of all coordinates and "young".

        Each value has the shape (n,); the result (n, n_samples).
        """
        softer = np.log(self.grid.softer(values))
        return np.asarray(self.grid.weights(values) @ self.log_force + softer[:, None])

    @property
    def measured(self) -> FloatArray:
        """Logarithm of the measured forces, shape (n_samples,)."""
        return np.asarray(np.log(self.palpation.force[self.palpation.sampled]))

    @property
    def touch(self) -> np.ndarray:
        """Number of each sample's touch, shape (n_samples,)."""
        return np.asarray(self.palpation.touch[self.palpation.sampled])

    def where(self, kept: np.ndarray) -> TouchTable:
        """Return the table of some touches only, a mask (n_touches,)."""
        samples = kept[self.touch]
        return replace(
            self,
            palpation=self.palpation.where(kept),
            log_force=self.log_force[:, samples],
            steepness=self.steepness[samples],
            error=self.error[samples],
        )

    def covariance(
        self, errors: TouchErrors, log_force: FloatArray, inflated: FloatArray | None = None
    ) -> FloatArray:
        """Return C at expected forces, shape (n_samples, n_samples).

        Parameters
        ----------
        log_force : ndarray, shape (n_samples,)
            Logarithm of the expected forces.
        inflated : ndarray or None, shape (n_touches,)
            Factor on the variance of the vademecum's own error at each touch.
        """
        same = (self.touch[:, None] == self.touch).astype(float)
        moved, own = errors.depth * self.steepness, self.error
        if inflated is not None:
            own = own * np.sqrt(inflated[self.touch])
        sensor = np.hypot(errors.sensor, errors.least * np.exp(-log_force))
        touches = same * (np.outer(moved, moved) + np.outer(own, own))
        return np.asarray(np.diag(sensor**2) + touches + errors.mesh**2)


@dataclass(frozen=True, eq=False)
class Calibration:
    """Posterior after a palpation.

    Attributes
    ----------
    known : Mapping[str, Distribution]
        Prior distributions, by parameter.
    names : tuple[str, ...]
        Names of the parameters that were not fixed.
    mean, covariance : ndarray, shapes (n,) and (n, n)
        Mean and covariance of their standard normal numbers.
    misfit : ndarray, shape (n_samples,)
        Misfit of ln F, measured less computed.
    deviations : ndarray, shape (n_touches,)
        Misfit of each touch over its standard deviation.
    probability : float
        Probability that so bad a fit comes by chance.
    notices : tuple[str, ...]
        Supports that are often out of the vademecum's range, by draws of the posterior.

    Examples
    --------
    >>> from scipy.stats import norm
    >>> known = {"young": av.uncertainty.Lognormal(5e3, 1.5)}
    >>> found = av.Calibration(known, ("young",), np.zeros(1), np.eye(1), *np.zeros((2, 9)), 0.5)
    >>> found.value("young"), found.explained
    (5000.0, True)
    """

    known: Mapping[str, Distribution]
    names: tuple[str, ...]
    mean: FloatArray
    covariance: FloatArray
    misfit: FloatArray
    deviations: FloatArray
    probability: float
    notices: tuple[str, ...] = ()

    @property
    def explained(self) -> bool:
        """Whether the model can have made these forces."""
        return self.probability >= LEAST_PROBABILITY and self.rms <= MOST_RMS

    @property
    def rms(self) -> float:
        """Root mean square of the misfit."""
        return float(np.sqrt(np.mean(self.misfit**2)))

    def value(self, name: str, deviations: float = 0.0) -> float:
        """Return the most probable value of a parameter, or one some deviations above it."""
        if name not in self.names:
            return float(self.known[name].ppf(np.array(0.5)))
        k = self.names.index(name)
        z = self.mean[k] + deviations * np.sqrt(self.covariance[k, k])
        return float(self.known[name].ppf(ndtr(z)))

    def interval(self, name: str) -> tuple[float, float]:
        """Return the values between which a parameter lies with 90 %."""
        return self.value(name, -NINETY), self.value(name, NINETY)

    def posterior(self, name: str) -> Distribution:
        """Return a lognormal distribution about the most probable value, as wide as the posterior.

        Its factor spans one standard deviation. It ignores correlations with other parameters; see
        :attr:`covariance`.
        """
        factor = np.sqrt(self.value(name, 1.0) / self.value(name, -1.0))
        middle = self.value(name)
        return Lognormal(middle, float(factor)) if factor > 1.0 else Fixed(middle)


def calibrate(
    vademecum: Vademecum,
    tips: ArrayLike,
    forces: ArrayLike,
    tip: Tip | None = None,
    known: Mapping[str, Distribution] | None = None,
    errors: TouchErrors | None = None,
) -> Calibration:
    """Find Young's modulus and the other coordinates from touches with measured forces.

    Parameters
    ----------
    tips : array_like, shape (n, 3)
        Places of the tip in the order of time [m], as :func:`avatar_core.contact.model.step` takes
        them. Each touch begins outside the organ.
    forces : array_like, shape (n,) or (n, 3)
        Measured forces at these places, as sizes or vectors [N].
    tip : Tip, optional
        The default is a sphere of 5 mm.
    known : mapping of str to Distribution, optional
        Prior distributions, by name of a parameter. A parameter that is not given may lie anywhere
        in the vademecum's range; Young's modulus lies between 500 Pa and 350 kPa.
    errors : TouchErrors, optional
        Standard deviations of sensor, surface and mesh.

    Returns
    -------
    Calibration

    Raises
    ------
    StorageError
        If the forces hold no touch.
    ContactError
        If fewer than three touches meet the organ, or there is not one force for each place.
    CoordinateError
        If the vademecum has no such parameter.

    Examples
    --------
    >>> model = av.prepare(v.at(young=6e3), av.Scene(effects=()))
    >>> data, tips, forces = model.data(), [], []
    >>> for j in places:  # four touches, each from outside
    ...     for depth in np.linspace(-6e-3, 4e-3, 60):
    ...         tips.append(v.surface.centers[j] + (5e-3 - depth) * v.surface.normals[j])
    ...         status = av.step(model, data, tips[-1])
    ...         forces.append(data.out.force[0].copy())
    >>> found = av.calibrate(v, tips, forces)
    >>> low, high = found.interval("young")
    >>> low < 6e3 < high
    True
    """
    size, path = np.asarray(forces, float), np.asarray(tips, float)
    size = np.linalg.norm(size, axis=1) if size.ndim == 2 else size
    if path.ndim != 2 or path.shape[1] != 3 or size.shape != path.shape[:1]:
        raise ContactError(
            f"tips of shape {path.shape} and forces of shape {np.shape(forces)} do not match; give "
            "tips (n, 3), and forces (n,) or (n, 3)"
        )
    palpation = palpation_of(path, size)
    table = touch_table(vademecum, tip or Tip(), palpation)
    return calibrated(table, priors_of(vademecum, known), errors)


def touch_table(
    vademecum: Vademecum,
    tip: Tip,
    palpation: Palpation,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> TouchTable:
    """Follow the touches at every material of the grid.

    Raises
    ------
    ContactError
        If too few of the touches meet the organ in the vademecum.
    """
    grid, force = MaterialGrid.of(vademecum), []
    error = np.zeros(len(palpation.tip))
    shape = Shape.of(vademecum, (tip,))
    for done, here in enumerate(grid.materials(vademecum)):
        model = ContactModel(lay_out(here, (tip,), Detail(1, "off"), shape=shape))
        found, expected = _followed(model, palpation)
        force.append(found)
        error = np.maximum(error, expected)
        progress(done + 1, grid.n_points)
    return _of_felt(grid, palpation, np.array(force), error)


def _of_felt(
    grid: MaterialGrid, palpation: Palpation, force: FloatArray, error: FloatArray
) -> TouchTable:
    """Return the table of the touches whose samples all have a force."""
    silent = palpation.sampled & ~(force > 0.0).all(axis=0)
    felt = np.bincount(palpation.touch, silent, palpation.n_touches) == 0
    if felt.sum() < _LEAST_TOUCHES:
        raise ContactError(
            f"{felt.sum()} of {len(felt)} touches meet the organ where it was computed, and "
            f"{_LEAST_TOUCHES} are needed; check the frame of the poses (--tool-transform) and the "
            "tip (--radius)"
        )
    chosen = felt[palpation.touch]
    kept = palpation.where(felt)
    with np.errstate(divide="ignore"):
        log_force = np.log(force[:, chosen])
    steepness = _steepness(kept, log_force[len(log_force) // 2])
    sampled = kept.sampled
    return TouchTable(
        grid,
        kept,
        int((~felt).sum()),
        log_force[:, sampled],
        steepness[sampled],
        error[chosen][sampled],
    )


def _followed(model: ContactModel, palpation: Palpation) -> tuple[FloatArray, FloatArray]:
    """Return the force along the paths [N], and its relative error, each (n,)."""
    data = model.data()
    force, error = np.zeros((2, len(palpation.tip)))
    before = -1
    for k, (touch, at) in enumerate(zip(palpation.touch, palpation.tip, strict=True)):
        if touch != before:
            data.reset()
        before, status = touch, step(model, data, at[None])
        size = float(np.linalg.norm(data.out.force[0]))
        if status in (Status.OK, Status.EXTRAPOLATED) and size > 0.0:
            estimate_error(model, data)
            expected = float(data.out.force_error[0]) / size / NINETY
            force[k], error[k] = size, expected if np.isfinite(expected) else _UNKNOWN
    return force, error


def _steepness(palpation: Palpation, log_force: FloatArray) -> FloatArray:
    """Return d ln F / d depth along the paths, shape (n,) [1/m]; zero where there is no force."""
    found = np.zeros(len(log_force))
    for touch in range(palpation.n_touches):
        here = np.flatnonzero((palpation.touch == touch) & np.isfinite(log_force))
        if len(here) == 0:
            continue
        first = here[0] - 1 if here[0] and palpation.touch[here[0] - 1] == touch else here[0]
        way = np.linalg.norm(palpation.tip[here] - palpation.tip[first], axis=1)
        way = np.maximum.accumulate(np.maximum(way, 1e-4))
        # F ~ d^a: d ln F / d d = a / d, with a from the touch itself.
        power = np.polyfit(np.log(way), log_force[here], 1)[0] if np.ptp(way) > 0.0 else 1.0
        found[here] = np.clip(power, 0.5, 2.0) / way
    return found


def calibrated(
    table: TouchTable, known: Mapping[str, Distribution], errors: TouchErrors | None = None
) -> Calibration:
    """Return the posterior of all parameters that are not fixed.

    Parameters
    ----------
    known : Mapping[str, Distribution]
        Prior of every coordinate and "young", see :func:`avatar_core.uncertainty.known.known_of`.
    """
    names = tuple(name for name, one in known.items() if not isinstance(one, Fixed))
    errors = errors or TouchErrors()
    # The part of the mesh's error in Young's modulus is no misfit.
    own = replace(errors, mesh=0.0) if "young" in names else errors

    def values_at(z: FloatArray) -> dict[str, FloatArray]:
        probability, middle = dict(zip(names, ndtr(z.T), strict=True)), np.full(len(z), 0.5)
        return {name: one.ppf(probability.get(name, middle)) for name, one in known.items()}

    def computed(z: FloatArray) -> FloatArray:
        return np.asarray(table.at(values_at(z[None]))[0])

    def whitened(z: FloatArray) -> FloatArray:
        misfit = table.measured - computed(z)
        return np.r_[solve_triangular(root, misfit, lower=True), z]

    # By the measured forces, those that noise made small would count less than those it made large.
    expected, at, inflated = table.measured, np.zeros(len(names)), None
    for _ in range(_N_WEIGHTINGS):
        root = np.linalg.cholesky(table.covariance(errors, expected, inflated))
        best = least_squares(whitened, at, bounds=(-_FARTHEST, _FARTHEST), jac="3-point")
        at, expected = best.x, computed(best.x)
        left = table.measured - expected
        together = _together(table.touch, table.covariance(own, expected))
        deviations = together @ left
        inflated = (_TAIL + deviations**2) / (_TAIL + 1.0)
    derivatives = together @ root @ best.jac[: len(left)]
    covariance = np.linalg.inv(best.jac.T @ best.jac) + np.diag(_extents(known, names, at, errors))
    normal = np.random.default_rng(0).standard_normal((_N_DRAWS, len(names)))
    return Calibration(
        known,
        names,
        np.asarray(at),
        covariance,
        left,
        deviations,
        chance(deviations, _places(table.palpation), derivatives, _TAIL),
        table.grid.notices(values_at(at + normal @ np.linalg.cholesky(covariance).T)),
    )


def _extents(
    known: Mapping[str, Distribution], names: tuple[str, ...], at: FloatArray, errors: TouchErrors
) -> FloatArray:
    """Return variances of the standard normal numbers by ``errors.extent``, shape (n,).

    They are no larger than the prior variances.
    """
    found = np.zeros(len(names))
    for k, name in enumerate(names):
        if name == "contrast" or name.startswith("support."):
            ends = known[name].ppf(ndtr(at[k] + np.array([-_STEP, _STEP])))
            slope = float(np.diff(np.log(ends))[0]) / (2.0 * _STEP)
            found[k] = min((errors.extent / max(slope, _FLAT)) ** 2, 1.0)
    return found


def _places(palpation: Palpation) -> FloatArray:
    """Return the deepest place of each touch, shape (n_touches, 3) [m]."""
    last = np.searchsorted(palpation.touch, np.arange(palpation.n_touches), side="right") - 1
    return palpation.tip[last]


def _together(touch: np.ndarray, covariance: FloatArray) -> FloatArray:
    """Return weights that make one misfit per touch from samples, over its deviation.

    Shape (n_touches, n_samples). The weights are those of least variance within a touch, C^-1 1 /
    sqrt(1^T C^-1 1).
    """
    out = np.zeros((touch[-1] + 1, len(touch)))
    for k, row in enumerate(out):
        own = np.flatnonzero(touch == k)
        weight = np.linalg.solve(covariance[np.ix_(own, own)], np.ones(len(own)))
        row[own] = weight / np.sqrt(weight.sum())
    return out
