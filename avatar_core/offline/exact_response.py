"""The full solutions of a build: each is computed once, and reduced to what the vademecum needs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from avatar_core.fem.elasticity import Elasticity
from avatar_core.fem.norms import l2_norm
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.offline.rule import NO_ERROR, BuildRule, Progress
from avatar_core.reduction.near_field import LocalBlocks, Pairs, near_pairs, plateau, wendland
from avatar_core.reduction.separated import SeparatedField

_BATCH = 40  # load positions solved at once
_TRIED = 2  # load positions on which single precision is tried,
SINGLE_ERROR = 1e-3  # and the relative error up to which it does: modes leave thirty times it


@dataclass(frozen=True)
class ExactResponse:
    """What is kept of the full solutions, each computed once and dropped.

    vertex, contact : LocalBlocks, exact displacement at near vertices and near positions
    vertex_pairs, contact_pairs : Pairs, their distances
    norm : ndarray, shape (n_loads,), mass-weighted L2 norm of each column [m^(5/2)/N]
    energy : ndarray, shape (n_loads,), patch compliance of each load [m/N]
    samples : ndarray of int, positions whose columns are kept; ``columns`` (3 n_vertices, 3 n)
        float32
    single : whether single precision does for the solutions
    """

    vertex: LocalBlocks
    contact: LocalBlocks
    vertex_pairs: Pairs
    contact_pairs: Pairs
    norm: np.ndarray
    energy: np.ndarray
    samples: np.ndarray
    columns: np.ndarray
    single: bool


def exact_response(
    elasticity: Elasticity,
    surface: LoadSurface,
    loads: sp.csr_matrix,
    rule: BuildRule,
    progress: Progress,
    single: bool = False,
) -> ExactResponse:
    """Solve for every load position and keep what the vademecum needs.

    single : solve in single precision where that does, in half the time
    """
    radius, n = surface.patch_radius, surface.n_positions
    vertices = elasticity.mesh.vertices
    widest = rule.near_growth * rule.near_outer * radius
    vertex_pairs = near_pairs(surface.centers, vertices, widest)
    contact_pairs = near_pairs(surface.centers, surface.centers, rule.contact_support * radius)
    vertex = np.empty((len(vertex_pairs.target), 3, 3), np.float32)
    contact = np.empty((len(contact_pairs.target), 3, 3))
    norm, energy = np.empty((n, 3)), np.empty((n, 3))
    sampled = np.random.default_rng(1).permutation(n)
    sampled = np.sort(sampled[: max(1, rule.max_sample_bytes // (36 * len(vertices)))])
    columns = np.empty((3 * len(vertices), len(sampled), 3), np.float32)
    place = {int(j): k for k, j in enumerate(sampled)}
    mass = elasticity.mesh.lumped_mass
    by_column, average = loads.tocsc(), loads.T.tocsr()
    tried = min(n, _TRIED)
    single = single and elasticity.single_error(by_column[:, : 3 * tried]) < SINGLE_ERROR
    for first in range(0, n, _BATCH):
        batch = range(first, min(first + _BATCH, n))
        solution = elasticity.solve(by_column[:, 3 * batch.start : 3 * batch.stop], single)
        displacement = elasticity.at_vertices(solution)
        at_vertex = displacement.reshape(len(vertices), 3, -1, 3)
        at_position = (average @ solution).reshape(n, 3, -1, 3)
        norm[batch] = l2_norm(displacement, mass).reshape(-1, 3)
        for k, j in enumerate(batch):
            row = slice(vertex_pairs.start[j], vertex_pairs.start[j + 1])
            vertex[row] = at_vertex[vertex_pairs.target[row], :, k]
            row = slice(contact_pairs.start[j], contact_pairs.start[j + 1])
            contact[row] = at_position[contact_pairs.target[row], :, k]
            energy[j] = np.diagonal(at_position[j, :, k])
            if j in place:
                columns[:, place[j]] = at_vertex[:, :, k].reshape(-1, 3)
        progress("solve", batch.stop / n, NO_ERROR)
    return ExactResponse(
        LocalBlocks(vertex_pairs.start, vertex_pairs.target, vertex),
        LocalBlocks(contact_pairs.start, contact_pairs.target, contact),
        vertex_pairs,
        contact_pairs,
        norm.ravel(),
        energy.ravel(),
        sampled,
        columns.reshape(3 * len(vertices), -1),
        single,
    )


class FarFieldResidual:
    """Error that the modes found so far leave in the sampled columns, outside the near field."""

    def __init__(
        self, elasticity: Elasticity, surface: LoadSurface, response: ExactResponse, rule: BuildRule
    ) -> None:
        distance = np.linalg.norm(
            elasticity.mesh.vertices[:, None] - surface.centers[response.samples][None], axis=2
        )
        inner, outer = (r * surface.patch_radius for r in (rule.near_inner, rule.near_outer))
        keep = 1.0 - plateau(distance, inner, outer)
        weight = elasticity.mesh.vertex_volumes[:, None] * keep**2
        self.loads = (3 * response.samples[:, None] + np.arange(3)).ravel()
        self._weight = np.repeat(weight, 3, axis=0).astype(np.float32)
        self._norm = response.norm[self.loads]
        self._columns = response.columns
        self._left: np.ndarray | None = None

    def reset(self) -> None:
        """Discard all modes and free their memory."""
        self._left = None

    def subtract(self, space: np.ndarray, load: np.ndarray) -> np.ndarray:
        """Subtract modes; returns the relative L2 error of each sampled load, shape (n,)."""
        if self._left is None:
            self._left = self._columns.copy()
        self._left -= space.astype(np.float32) @ load[self.loads].astype(np.float32).T
        left = self._left.reshape(len(self._weight), -1, 3)
        squared = np.einsum("vs,vsc,vsc->sc", self._weight, left, left, optimize=False)
        return np.sqrt(squared).ravel() / self._norm


def displacement_near(
    far: SeparatedField,
    response: ExactResponse,
    surface: LoadSurface,
    rule: BuildRule,
    outliers: np.ndarray,
) -> LocalBlocks:
    """(u - far) at the vertices around each position, faded out; stored in full at outliers."""
    radius = surface.patch_radius
    fade = plateau(
        response.vertex_pairs.distance, rule.near_inner * radius, rule.near_outer * radius
    )
    blocks = remainder(response.vertex, far.space, far.load, fade)
    blocks = blocks.kept(response.vertex_pairs.distance < rule.near_outer * radius)
    rows = {}
    for j in outliers:
        k = 3 * int(np.searchsorted(response.samples, j))
        left = response.columns[:, k : k + 3] - far.space @ far.load[3 * j : 3 * j + 3].T
        rows[int(j)] = left.reshape(-1, 3, 3).astype(np.float32)
    return blocks.with_whole_rows(rows)


def contact_near(
    far: SeparatedField, response: ExactResponse, surface: LoadSurface, rule: BuildRule
) -> LocalBlocks:
    """(C - Y Y^T), tapered by Wendland's function and exactly symmetric."""
    support = rule.contact_support * surface.patch_radius
    taper = wendland(response.contact_pairs.distance, support)
    blocks = remainder(response.contact, far.load, far.load, taper)
    return replace(blocks, block=_symmetrized(blocks))


def remainder(
    exact: LocalBlocks, target: np.ndarray, load: np.ndarray, fade: np.ndarray
) -> LocalBlocks:
    rank = target.shape[1]
    target, load = target.reshape(-1, 3, rank), load.reshape(-1, 3, rank)
    block = np.empty(exact.block.shape, np.float32)
    for j in range(len(exact.start) - 1):
        row = slice(exact.start[j], exact.start[j + 1])
        smooth = (target[exact.target[row]].reshape(-1, rank) @ load[j].T).reshape(-1, 3, 3)
        block[row] = fade[row, None, None] * (exact.block[row] - smooth)
    return LocalBlocks(exact.start, exact.target, block)


def _symmetrized(blocks: LocalBlocks) -> np.ndarray:
    """(B + B^T) / 2 block by block: rounding is all it removes (Maxwell-Betti)."""
    order = np.lexsort((blocks.position, blocks.target))  # the transpose, in the same pattern
    return 0.5 * (blocks.block + blocks.block[order].transpose(0, 2, 1))
