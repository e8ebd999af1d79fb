"""An organ's surface drawn smoothly: each triangle in four, by the butterfly scheme.

The middle of an edge a b, whose triangles have the third corners c and d and whose neighbours end
in e, f, g and h, is put at (Dyn, Levin and Gregory, ACM Transactions on Graphics 9, 1990)

    (a + b) / 2 + (c + d) / 8 - (e + f + g + h) / 16.

The given points stay where they are. For pictures; nothing here is felt or measured.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.sparse as sp

from avatar_core.contact.fine_surface import FineSurface

FINE = 16000  # triangles of a surface that is drawn as it is


class Refined(NamedTuple):
    """A surface with further points, the given ones first.

    blend : sparse matrix, shape (n', n), of the given points
    faces : ndarray of int, shape (m', 3); triangle k of the given ones becomes 4 k to 4 k + 3
    sides : ndarray of int, shape (m, 3), further points on the sides of the given triangles
    ends : ndarray of int, shape (n' - n, 2), of the edges on which the further points lie
    """

    blend: sp.csr_matrix
    faces: np.ndarray
    sides: np.ndarray
    ends: np.ndarray

    @property
    def is_finer(self) -> bool:
        """Whether there are further points."""
        return len(self.ends) > 0


def refined(n: int, faces: np.ndarray) -> Refined:
    """The surface of ``n`` points, refined unless it is fine."""
    faces = np.asarray(faces, int)
    if len(faces) > FINE:
        none = np.empty((0, 2), int)
        return Refined(sp.identity(n, format="csr"), faces, np.zeros((len(faces), 3), int), none)
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2).reshape(-1, 2)
    key = edges[:, 0] * n + edges[:, 1]
    unique, number = np.unique(key, return_inverse=True)
    ends = np.column_stack([unique // n, unique % n])
    blend = sp.vstack([sp.identity(n), _middles(n, faces, ends, number)], format="csr")
    number = number.reshape(-1, 3)
    (a, b, c), (ab, bc, ca) = faces.T, n + number.T
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    four = np.stack([np.stack(part, axis=1) for part in parts], axis=1).reshape(-1, 3)
    return Refined(blend, four, number, ends)


def _middles(n: int, faces: np.ndarray, ends: np.ndarray, number: np.ndarray) -> sp.csr_matrix:
    """The further points as sums of the given ones."""
    n_edges, corner = len(ends), faces[:, [2, 0, 1]].reshape(-1)  # opposite to each side
    order = np.argsort(number, kind="stable")
    first = np.searchsorted(number[order], np.arange(n_edges))
    count = np.bincount(number, minlength=n_edges)
    inner = np.flatnonzero(count == 2)
    plain = sp.csr_matrix(
        (np.full(2 * n_edges, 0.5), (np.repeat(np.arange(n_edges), 2), ends.reshape(-1))),
        shape=(n_edges, n),
    )
    other = np.full(number.size, -1)  # the same side of the neighbour
    one, two = order[first[inner]], order[first[inner] + 1]
    other[one], other[two] = two, one
    rows, columns, values = [], [], []
    whole = np.ones(n_edges, bool)
    whole[count != 2] = False
    for half in (one, two):
        rows.append(inner)
        columns.append(corner[half])
        values.append(np.full(len(inner), 0.125))
        for turn in (1, 2):
            beside = 3 * (half // 3) + (half + turn) % 3
            wing = other[beside]
            whole[inner[wing < 0]] = False
            rows.append(inner)
            columns.append(corner[np.maximum(wing, 0)])
            values.append(np.full(len(inner), -0.0625))
    row = np.concatenate(rows)
    kept = whole[row]
    change = sp.csr_matrix(
        (np.concatenate(values)[kept], (row[kept], np.concatenate(columns)[kept])),
        shape=(n_edges, n),
    )
    return plain + change


def finer(shape: Refined, shown: FineSurface) -> FineSurface:
    """What is shown of a cloud on the refined surface; what is finer still, under a tip, stays."""
    n, n_all = shape.blend.shape[1], shape.blend.shape[0]
    if not shape.is_finer:
        return shown
    both = np.hstack([shown.positions[:n], shown.displacements[:n]])
    points = shape.blend @ both
    times = np.bincount(shown.parents, minlength=len(shape.sides))
    is_split = times > 1
    middle = np.unique(shape.sides[is_split])  # as under the tip: in the middle of the edge
    points[n + middle] = both[shape.ends[middle]].mean(axis=1)
    left = np.flatnonzero(~is_split)
    of_tip = times[shown.parents] > 1
    under = shown.faces[of_tip]
    under = np.where(under < n, under, under + (n_all - n))
    four = (4 * left[:, None] + np.arange(4)).reshape(-1)
    extra = np.hstack([shown.positions[n:], shown.displacements[n:]])
    points = np.concatenate([points, extra])
    between = _between(shape, _borders(under, n_all))
    points, beside, of_beside = _joined(points, shape.faces[four], four, between)
    return FineSurface(
        points[:, :3],
        points[:, 3:],
        np.concatenate([beside, under]),
        np.concatenate([of_beside, 4 * shown.parents[of_tip]]),
    )


def _borders(under: np.ndarray, n_all: int) -> list[list[int]]:
    """Chains of points along the border of the finest faces, from one of the others to the next.

    under : ndarray of int, shape (m, 3); points from ``n_all`` on are of these faces alone
    """
    if len(under) == 0:
        return []
    edges = under[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    base = int(under.max()) + 1
    key = edges[:, 0] * base + edges[:, 1]
    outer = edges[~np.isin(key, edges[:, 1] * base + edges[:, 0])]
    follows = {int(a): int(b) for a, b in outer if a >= n_all}
    chains = []
    for a, b in outer[outer[:, 0] < n_all].tolist():
        chain = [a, b]
        while chain[-1] >= n_all:
            chain.append(follows[chain[-1]])
        chains.append(chain)
    return chains


def _between(shape: Refined, chains: list[list[int]]) -> dict[tuple[int, int], list[int]]:
    """Points of chains between both ends of a side of the refined faces, as these go round."""
    n = shape.blend.shape[1]
    key = shape.ends[:, 0] * n + shape.ends[:, 1]  # ascending
    found = {}
    for first, *inner, last in chains:
        low, high = min(first, last), max(first, last)
        middle = n + int(np.searchsorted(key, low * n + high))
        half = len(inner) // 2  # the point there is the middle, too
        found[middle, first] = inner[:half][::-1]
        found[last, middle] = inner[half + 1 :][::-1]
    return found


def _joined(
    points: np.ndarray,
    faces: np.ndarray,
    parents: np.ndarray,
    between: dict[tuple[int, int], list[int]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, faces and their parents, with the faces beside a finer border split from the middle.

    A browser leaves pixels open where a point lies on the side of a triangle that does not have it.
    """
    ends = list({end for side in between for end in side})
    beside = np.flatnonzero(np.isin(faces, ends).sum(axis=1) >= 2)
    split: list[int] = []
    fans: list[tuple[int, int, int, int]] = []
    for k in beside.tolist():
        a, b, c = faces[k].tolist()
        ring = [p for side in ((a, b), (b, c), (c, a)) for p in (side[0], *between.get(side, ()))]
        if len(ring) > 3:
            middle = len(points) + len(split)
            fans += [(p, q, middle, k) for p, q in zip(ring, ring[1:] + ring[:1], strict=True)]
            split.append(k)
    new = np.array(fans, int).reshape(-1, 4)
    kept = np.setdiff1d(np.arange(len(faces)), split)
    return (
        np.concatenate([points, points[faces[split]].mean(axis=1)]) if split else points,
        np.concatenate([faces[kept], new[:, :3]]),
        np.concatenate([parents[kept], parents[new[:, 3]]]),
    )
