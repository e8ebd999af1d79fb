"""Typed errors of the offline part; each message names cause and remedy in one line."""

from __future__ import annotations


class AvatarError(Exception):
    """Base of every error that a user can cause and cure.

    Examples
    --------
    >>> try:
    ...     av.Material(poisson_ratio=0.7)
    ... except av.AvatarError as error:
    ...     print(str(error)[:22])
    Poisson's ratio is 0.7
    """


def one_line(error: object, longest: int = 500) -> str:
    """Return the text of an error in one line, of at most ``longest`` printable letters."""
    line = " ".join(str(error).split()) or type(error).__name__
    return "".join(letter if letter.isprintable() else "?" for letter in line[:longest])


class SurfaceError(AvatarError):
    """The organ surface cannot be read or does not bound one organ of plausible size."""


class MeshError(AvatarError):
    """The volume mesh is missing, degenerate or inverted, or a region of it is empty."""


class MaterialError(AvatarError):
    """A material parameter lies outside the range in which the model is well posed."""


class LoadError(AvatarError):
    """A load patch or load direction does not fit the surface it acts on."""


class StorageError(AvatarError):
    """A file is truncated, altered, of another schema, or cannot be written."""


class ContactError(AvatarError):
    """A contact model cannot be prepared from what was asked."""


class ConvergenceError(AvatarError):
    """An iteration reached its limit before its tolerance."""


class LLEError(AvatarError):
    """A base of shapes, or what is asked of it, does not allow barycentric weights."""


class RegistrationError(AvatarError):
    """A template cannot be laid on a surface without leaving it or crushing elements."""


class CoordinateError(AvatarError):
    """A coordinate that a vademecum does not have, or a value outside its range."""


class EquilibriumError(AvatarError):
    """A deformed organ has no stable equilibrium under the load that was asked for."""


class AccuracyError(AvatarError):
    """A budget of error and time that cannot be met, or was never measured."""


class SceneError(AvatarError):
    """A scene asks for what does not exist, does not fit together or lies out of range."""
