"""Distributions of a parameter: a fixed value, a range, or a median with a factor.

A vademecum is exact to some per cent for a problem whose data are less certain. A distribution
states the knowledge of one coordinate, or of Young's modulus.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import yaml

from avatar_core.common.arrays import FloatArray
from avatar_core.common.files import FileError, content_of, opened, shipped_files
from avatar_core.errors import CoordinateError

LEAST_INSIDE = 0.9  # least probability of a distribution within a vademecum's range
MAX_BYTES = 16_000  # largest file of distributions
SHIPPED = "uncertainty"  # folder of the shipped distributions


class Distribution(Protocol):
    """A parameter's distribution, by its quantile function."""

    def ppf(self, probability: FloatArray) -> FloatArray:
        """Return the values below which the parameter lies with some probabilities (0 to 1)."""

    def cdf(self, value: float) -> float:
        """Return the probability that the parameter lies below a value."""

    def said(self, unit: str = "") -> str:
        """Return the distribution in words, with a unit."""


@dataclass(frozen=True)
class Fixed:
    """A value that is known.

    Examples
    --------
    >>> av.uncertainty.Fixed(4.0).ppf(np.array([0.1, 0.9]))
    array([4., 4.])
    """

    value: float

    def __post_init__(self) -> None:
        if not math.isfinite(self.value):
            raise CoordinateError(f"fixed:{self.value:g}: give a finite number")

    def ppf(self, probability: FloatArray) -> FloatArray:
        """Return the quantiles at some probabilities (0 to 1)."""
        return np.full(np.shape(probability), self.value)

    def cdf(self, value: float) -> float:
        """Return the probability that the parameter lies below a value."""
        return float(value >= self.value)

    def said(self, unit: str = "") -> str:
        """Return the distribution in words, with a unit."""
        return f"{self.value:g}{unit}"


@dataclass(frozen=True)
class Uniform:
    """Anywhere between two values, all alike.

    Examples
    --------
    >>> av.uncertainty.Uniform(0.40, 0.48).ppf(0.5).round(2)
    0.44
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        if not -math.inf < self.low < self.high < math.inf:
            raise CoordinateError(
                f"uniform:{self.low:g}:{self.high:g} is empty; give finite LOW < HIGH"
            )

    def ppf(self, probability: FloatArray) -> FloatArray:
        """Return the quantiles at some probabilities (0 to 1)."""
        return self.low + (self.high - self.low) * np.asarray(probability)

    def cdf(self, value: float) -> float:
        """Return the probability that the parameter lies below a value."""
        return min(max((value - self.low) / (self.high - self.low), 0.0), 1.0)

    def said(self, unit: str = "") -> str:
        """Return the distribution in words, with a unit."""
        return f"{self.low:g} to {self.high:g}{unit}, all alike"


@dataclass(frozen=True)
class LogUniform:
    """Anywhere between two positive values, every factor alike.

    Examples
    --------
    >>> av.uncertainty.LogUniform(1e3, 1e5).ppf(0.5).round()
    10000.0
    """

    low: float
    high: float

    def __post_init__(self) -> None:
        if not 0.0 < self.low < self.high < math.inf:
            raise CoordinateError(
                f"loguniform:{self.low:g}:{self.high:g} is empty; give 0 < LOW < HIGH"
            )

    def ppf(self, probability: FloatArray) -> FloatArray:
        """Return the quantiles at some probabilities (0 to 1)."""
        return np.asarray(self.low * (self.high / self.low) ** np.asarray(probability))

    def cdf(self, value: float) -> float:
        """Return the probability that the parameter lies below a value."""
        if value <= self.low:
            return 0.0
        return min(math.log(value / self.low) / math.log(self.high / self.low), 1.0)

    def said(self, unit: str = "") -> str:
        """Return the distribution in words, with a unit."""
        return f"{self.low:g} to {self.high:g}{unit}, every factor alike"


@dataclass(frozen=True)
class Lognormal:
    """Lognormal distribution: ln x is normal about ln median.

    Two thirds lie within median / factor and median * factor.

    Examples
    --------
    >>> av.uncertainty.Lognormal(5e3, 1.5).ppf(0.5).round()
    5000.0
    """

    median: float
    factor: float

    def __post_init__(self) -> None:
        if not (0.0 < self.median < math.inf and 1.0 < self.factor < math.inf):
            raise CoordinateError(
                f"lognormal:{self.median:g}:{self.factor:g}: give a positive median and a factor "
                "above 1, both finite"
            )

    def ppf(self, probability: FloatArray) -> FloatArray:
        """Return the quantiles at some probabilities (0 to 1)."""
        # Here, because the contact node needs none of it.
        from scipy.special import ndtri

        return np.asarray(self.median * self.factor ** ndtri(probability))

    def cdf(self, value: float) -> float:
        """Return the probability that the parameter lies below a value."""
        if value <= 0.0:
            return 0.0
        deviations = math.log(value / self.median) / math.log(self.factor)
        return 0.5 * math.erfc(-deviations / math.sqrt(2.0))

    def said(self, unit: str = "") -> str:
        """Return the distribution in words, with a unit."""
        return f"{self.median:g}{unit}, give or take a factor of {self.factor:g}"


@dataclass(frozen=True)
class Within:
    """A distribution that is cut off at the ends of a range and renormalised."""

    whole: Distribution
    low: float
    high: float

    @property
    def inside(self) -> float:
        """Fraction of the whole distribution within the range, ends included."""
        below = self.whole.cdf(np.nextafter(self.low, -np.inf))
        return self.whole.cdf(self.high) - below

    def ppf(self, probability: FloatArray) -> FloatArray:
        """Return the quantiles at some probabilities (0 to 1)."""
        first, last = self.whole.cdf(self.low), self.whole.cdf(self.high)
        drawn = self.whole.ppf(first + (last - first) * np.asarray(probability))
        return np.clip(drawn, self.low, self.high)

    def cdf(self, value: float) -> float:
        """Return the probability that the parameter lies below a value."""
        first, last = self.whole.cdf(self.low), self.whole.cdf(self.high)
        return min(max((self.whole.cdf(value) - first) / (last - first), 0.0), 1.0)

    def said(self, unit: str = "") -> str:
        """Return the distribution in words, with a unit."""
        return self.whole.said(unit)


_KINDS: dict[str, type[Fixed | Uniform | LogUniform | Lognormal]] = {
    "fixed": Fixed,
    "uniform": Uniform,
    "loguniform": LogUniform,
    "lognormal": Lognormal,
}
_NUMBERS = {kind: tuple(one.name for one in fields(made)) for kind, made in _KINDS.items()}
_EXAMPLE = "write young=lognormal:5e3:1.5, poisson=uniform:0.4:0.49 or contrast=fixed:4"


def parse(text: str) -> tuple[str, Distribution]:
    """Parse ``NAME=KIND:NUMBERS`` from the command line, e.g. `young=lognormal:5300:1.33`."""
    name, _, told = text.partition("=")
    kind, *numbers = told.split(":")
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        values = []
    if kind not in _KINDS or len(values) != len(_NUMBERS[kind]) or not np.isfinite(values).all():
        raise CoordinateError(f"distribution '{text}' is not understood; {_EXAMPLE}")
    return name.strip(), _KINDS[kind](*values)


def within(name: str, whole: Distribution, low: float, high: float) -> Distribution:
    """Return a distribution cut off at the range that a vademecum holds.

    Raises
    ------
    CoordinateError
        If less than ``LEAST_INSIDE`` of it lies in the range.
    """
    found = Within(whole, low, high)
    if found.inside < LEAST_INSIDE:
        raise CoordinateError(
            f"{found.inside:.0%} of {name} ({whole.said()}) lies within {low:g} to {high:g}, "
            f"which the vademecum holds; build it with a wider --coordinate {name}=LOW:HIGH"
        )
    return whole if isinstance(whole, Fixed) else found


_WRITTEN = "write young: {lognormal: {median: 5.0e+3, factor: 1.5}}"


def distribution_file(value: str) -> Path:
    """Return the file that a text names: a path if it has a /, else a shipped file.

    Raises
    ------
    CoordinateError
        If no shipped file has that name; lists the shipped files.
    """
    if "/" in value:
        return Path(value).expanduser().absolute()
    known = shipped_files(SHIPPED)
    if (stem := value.removesuffix(".yaml")) not in known:
        raise CoordinateError(
            f"no distributions {value!r} come with avatar; give a path with a /, or one of "
            f"{', '.join(known) or 'none: none is installed'}"
        )
    return known[stem]


def read_distributions(file: Path) -> dict[str, Distribution]:
    """Read distributions of parameters from a YAML file, by name; see ``params/uncertainty``.

    Raises
    ------
    CoordinateError
        For a file that cannot be read, has more than ``MAX_BYTES`` or holds something else.

    Examples
    --------
    >>> _ = open("known.yaml", "w").write("poisson: {uniform: {low: 0.4, high: 0.48}}")
    >>> av.uncertainty.read_distributions("known.yaml")
    {'poisson': Uniform(low=0.4, high=0.48)}
    """
    try:
        with opened(file, MAX_BYTES) as source:
            told = yaml.safe_load(content_of(source).decode())
    except (FileError, yaml.YAMLError, ValueError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise CoordinateError(f"cannot read distributions from {file}: {reason}") from error
    if not isinstance(told, dict) or not told:
        raise CoordinateError(f"{file} names no parameter; {_WRITTEN}")
    return of_mappings(told, str(file))


def of_mappings(told: Mapping[Any, Any], origin: str) -> dict[str, Distribution]:
    """Return distributions by parameter, from a file's mappings.

    Raises
    ------
    CoordinateError
        For a value that is no distribution; names ``origin`` and the parameter.
    """
    return {str(name): _of_mapping(origin, name, one) for name, one in told.items()}


def mappings(known: Mapping[str, Distribution]) -> dict[str, dict[str, Any]]:
    """Return mappings for a file, the inverse of :func:`of_mappings`; not for cut distributions."""
    found = {}
    for name, one in known.items():
        kind = next(kind for kind, made in _KINDS.items() if isinstance(one, made))
        found[name] = {kind: one.value if isinstance(one, Fixed) else asdict(one)}  # type: ignore[call-overload]
    return found


def _of_mapping(origin: str, name: object, told: object) -> Distribution:
    if isinstance(told, dict) and len(told) == 1:
        ((kind, values),) = told.items()
        names = _NUMBERS.get(kind, ())
        values = {"value": values} if kind == "fixed" else values
        if isinstance(values, dict) and set(values) == set(names) and _are_finite(values):
            return _KINDS[kind](*(float(values[field]) for field in names))
    raise CoordinateError(f"{origin}: '{name}' is not understood; {_WRITTEN}")


def _are_finite(values: Mapping[Any, Any]) -> bool:
    largest = sys.float_info.max  # whole numbers may be larger than any other
    return all(type(v) in (int, float) and abs(v) <= largest for v in values.values())
