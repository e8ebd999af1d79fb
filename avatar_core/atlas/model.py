"""An atlas: a folder of anatomies on one frame, whose shapes are held in memory.

A new patient is found by shape. Level sets and responses take a hundred times the memory. They are
read only for the anatomies that are used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Generic, TypeVar, overload

import numpy as np

from avatar_core.atlas.anatomy import Anatomy, AtlasError, Duplicate, Response
from avatar_core.atlas.frame import Frame
from avatar_core.common.arrays import FloatArray, IntArray
from avatar_core.geometry.mesh import TetMesh
from avatar_core.shapes.registration import Registration
from avatar_core.shapes.weights import SAME, Vectors

Item = TypeVar("Item")

# More neighbors than 45 of 64 livers change no error (`avatar study transport`).
MOST_NEIGHBORS = 64


class Lazy(Sequence[Item], Generic[Item]):
    """A sequence whose items are made on access; the last used ones are kept.

    make : function that returns the item of a number
    n : length
    kept : number of items that are kept
    """

    def __init__(self, make: Callable[[int], Item], n: int, kept: int = 0) -> None:
        self._n = n
        self._item = lru_cache(kept)(make) if kept else make

    def __len__(self) -> int:
        return self._n

    @overload
    def __getitem__(self, index: int) -> Item: ...
    @overload
    def __getitem__(self, index: slice) -> list[Item]: ...
    def __getitem__(self, index: int | slice) -> Item | list[Item]:
        if isinstance(index, slice):
            return [self._item(i) for i in range(self._n)[index]]
        return self._item(range(self._n)[index])


@dataclass(frozen=True, eq=False)
class Atlas:
    """Anatomies that can be compared.

    Attributes
    ----------
    anatomies : tuple[Anatomy, ...]
        Anatomies in the order of their names.
    read_distances : Callable
        Function that returns the signed distances of an anatomy, shape (n_points,) [m].
    read_response : Callable
        Function that returns the Response of an anatomy that has one.

    Notes
    -----
    The readers raise StorageError for a file that is missing, altered or of another anatomy.

    Examples
    --------
    >>> atlas.names
    ('larger', 'phantom')
    """

    frame: Frame
    anatomies: tuple[Anatomy, ...]
    read_distances: Callable[[Anatomy], FloatArray]
    read_response: Callable[[Anatomy], Response]

    def __len__(self) -> int:
        return len(self.anatomies)

    def __getitem__(self, name: str) -> Anatomy:
        return self.anatomies[self.index(name)]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the anatomies, in their order."""
        return tuple(anatomy.name for anatomy in self.anatomies)

    @property
    def vectors(self) -> Lazy[FloatArray]:
        """Distance vectors, n arrays of shape (n_points,) [m], each read when it is asked for."""
        return Lazy(lambda i: self.read_distances(self.anatomies[i]), len(self))

    def index(self, name: str) -> int:
        """Return the number of an anatomy.

        Raises AtlasError if there is none of that name.
        """
        if name not in self.names:
            raise AtlasError(f"no anatomy '{name}' in the atlas; 'avatar atlas show' names them")
        return self.names.index(name)

    @cached_property
    def same_as(self) -> IntArray:
        """Number of the first member with the same shape, mostly its own, shape (n,)."""
        return first_equal(centred([anatomy.registered for anatomy in self.anatomies]))

    @property
    def duplicates(self) -> tuple[Duplicate, ...]:
        """Members that repeat an earlier one."""
        repeated = np.flatnonzero(self.same_as != np.arange(len(self)))
        return tuple(Duplicate(self.names[i], self.names[self.same_as[i]]) for i in repeated)

    def registration(self, name: str) -> Registration:
        """Return the registration of an anatomy, without its history."""
        one, template = self[name], self.frame.template
        mesh = TetMesh(one.registered, template.mesh.tets)
        return Registration(template, mesh, one.alignment, one.quality, (), one.converged)


def centred(vertices: Vectors) -> Lazy[FloatArray]:
    """Return vertices, each of shape (n, 3), without their translation, as vectors (3 n,) [m]."""

    def vector(i: int) -> FloatArray:
        exact = np.asarray(vertices[i], dtype=np.float64)
        return (exact - exact.mean(axis=0)).ravel()

    return Lazy(vector, len(vertices))


def first_equal(vectors: Sequence[FloatArray]) -> IntArray:
    """Return the number of the first vector equal to each, mostly its own, shape (n,).

    Equal vectors have equal lengths: those next to each other in the order of length are compared.
    """
    length = np.array([np.linalg.norm(vector) for vector in vectors])
    near = SAME * length.max(initial=0.0)
    order, same = np.argsort(length, kind="stable"), np.arange(len(length))
    for place, i in enumerate(order):
        for j in order[place + 1 :]:
            if length[j] - length[i] > near:
                break
            if np.linalg.norm(vectors[i] - vectors[j]) <= near:
                same[same == max(same[i], same[j])] = min(same[i], same[j])
    return same
