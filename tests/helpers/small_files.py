"""The smallest vademecum and atlas that the loaders accept: all arrays present, none large.

A mutation hits the structure of such a file as often as its numbers, and thousands are read in a
minute. The organ is a ball; numbers that no loader's formula uses are random.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import ConvexHull

from avatar_core.atlas.anatomy import Anatomy, Origin, Response, WholeAnatomy
from avatar_core.atlas.frame import Frame
from avatar_core.fem.elasticity import Material
from avatar_core.fem.patch_loads import LoadSurface
from avatar_core.geometry.level_set import GridBox
from avatar_core.geometry.mesh import MeshQuality, Regions, TetMesh
from avatar_core.reduction.block_field import BLOCK, BlockField, blocks_of
from avatar_core.reduction.coordinates import Coordinate
from avatar_core.reduction.near_field import LocalBlocks, Mirror
from avatar_core.reduction.pgd import EnrichmentReport, EnrichmentStatus
from avatar_core.reduction.separated import SeparatedField
from avatar_core.shapes.registration import RegistrationQuality, SimilarityTransform, Template
from avatar_core.vademecum.certificate import Certificate
from avatar_core.vademecum.large_deformation import POWERS, LargeCertificate, LargeDeformation
from avatar_core.vademecum.modal_mass import BodyResponse
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.parametric import ParametricResponse
from avatar_core.vademecum.record import Convergence, Provenance, RankError
from avatar_core.vademecum.tip_field import Outline, TipField

RADIUS = 0.06  # [m]
RANK = 3


def ball(n: int = 24, radius: float = RADIUS) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) [m] spread evenly on a sphere, and outward faces (2 n - 4, 3)."""
    k = np.arange(n) + 0.5
    z, turn = 1.0 - 2.0 * k / n, np.pi * (1.0 + 5.0**0.5) * k
    flat = np.sqrt(1.0 - z**2)
    unit = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])
    faces = ConvexHull(unit).simplices.astype(np.int64)
    inward = np.linalg.det(unit[faces]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return radius * unit, faces


def small_vademecum(parametric: bool = False, large: bool = False) -> Vademecum:
    """Build a ball of tetrahedra about its centre, accessible on all faces but one."""
    rng = np.random.default_rng(0)
    points, faces = ball()
    n, n_vertices = len(points), len(points) + 1
    vertices = np.vstack([points, np.zeros(3)])
    mesh = TetMesh(vertices, np.column_stack([np.full(len(faces), n), faces]))
    clamped = np.arange(len(faces)) == 0
    region = np.arange(n, dtype=np.int32) % 2
    vademecum = Vademecum(
        name="ball",
        mesh=mesh,
        regions=Regions(clamped, ~clamped),
        material=Material(),
        element="P2",
        surface=LoadSurface(
            points, points / RADIUS, faces[1:], np.arange(n, dtype=np.int64), 0.012
        ),
        far=_field(rng, 3 * n_vertices, 3 * n, RANK),
        blocks=blocks_of(vertices, np.arange(n)),
        field=_block_field(rng, region, 3, RANK),
        trailing=1e-3 * rng.normal(size=(3 * n, 2)).astype(np.float32),
        contact_near=_blocks(n),
        tip_field=_tip_field(),
        convergence=Convergence(
            True,
            0.05,
            (EnrichmentReport(EnrichmentStatus.CONVERGED, RANK, 2, 1e-3, 0.02),),
            (RankError(RANK, 0.03, 0.08),),
        ),
        provenance=Provenance("ball.obj", "", versions=("avatar 0",), notices=("a ball",)),
        certificate=replace(Certificate.unknown(), l2_mean=0.03, n_loads=5),
        body=_body(rng, RANK),
    )
    if parametric:
        vademecum = replace(vademecum, parametric=_parametric(rng, vademecum))
    return replace(vademecum, large=_large(rng, vademecum)) if large else vademecum


def small_atlas(n_anatomies: int = 2) -> tuple[Frame, list[WholeAnatomy]]:
    """Build balls of several sizes, with responses, on a grid of 27 points."""
    rng = np.random.default_rng(1)
    points, faces = ball()
    vertices = np.vstack([points, np.zeros(3)])
    mesh = TetMesh(vertices, np.column_stack([np.full(len(faces), len(points)), faces]))
    clamped = np.arange(len(mesh.boundary_faces)) == 0
    box = GridBox((-0.1, -0.1, -0.1), 0.1, (3, 3, 3))
    anatomies = []
    for k in range(n_anatomies):
        size = 1.0 + 0.1 * k
        quality = RegistrationQuality(
            1e-3, 2e-3, 1e-3, 2e-3, 0.9, 0.01, MeshQuality(30.0, 120.0, 0.5)
        )
        field = _field(rng, vertices.size, 3 * len(points), RANK)
        stiff = np.tile(np.eye(3), (len(points), 1, 1)) * 1e-4
        response = Response(field.space, field.load, stiff, Material(), "P2", 0.012)
        shape = Anatomy(
            name=f"ball-{k}",
            key=f"key {k}",
            origin=Origin(f"{k:064d}", "mm", "RAS", len(points)),
            volume=4e-4 * size**3,
            alignment=SimilarityTransform(size, np.eye(3), np.zeros(3)),
            registered=size * vertices,
            quality=quality,
            converged=True,
            response=response.kind,
        )
        distances = np.linalg.norm(box.points, axis=1) - size * RADIUS
        anatomies.append(WholeAnatomy(shape, distances, response))
    return Frame(Template("ball", mesh, Regions(clamped, ~clamped)), box), anatomies


def _field(rng: np.random.Generator, n_dofs: int, n_loads: int, rank: int) -> SeparatedField:
    return SeparatedField(
        rng.normal(size=(n_dofs, rank)).astype(np.float32),
        1e-2 * rng.normal(size=(n_loads, rank)).astype(np.float32),
    )


def _blocks(n_positions: int) -> LocalBlocks:
    """Build blocks that couple each position with itself and with the next; symmetric."""
    start = np.append(np.arange(0, 2 * n_positions, 2), 2 * n_positions - 1)
    target = np.repeat(np.arange(n_positions), 2)[:-1]
    target[1::2] += 1
    mirror = Mirror.of(start, target)
    block = np.tile(1e-4 * np.eye(3, dtype=np.float32), (len(mirror.target), 1, 1))
    return LocalBlocks(mirror.start, mirror.target, block)


def _block_field(
    rng: np.random.Generator, region: np.ndarray, n_loads: int, n_shared: int
) -> BlockField:
    """Build two regions, with two modes and one, in two blocks of two modes each."""
    count = n_shared + np.array([0, 2, 1], np.int32)
    load = 1e-4 * rng.normal(size=(len(region), n_loads, n_shared + 2)).astype(np.float32)
    load[region == 1, :, -1] = 0.0
    start = np.array([[0, 1, 2], [2, 4, 6], [6, 8, 10]]) - 2 * (n_shared == 0)
    start = np.maximum(start, 0)
    n = int(start[-1, -1])
    return BlockField(
        region,
        load,
        count,
        rng.integers(-32767, 32767, (n, BLOCK), np.int16),
        1e-5 * rng.normal(size=(n, n_shared + 2)).astype(np.float32),
        np.ones(n, np.int32),
        start,
    )


def _body(rng: np.random.Generator, rank: int) -> BodyResponse:
    return BodyResponse(1e-6 * np.eye(rank), 1e-4 * rng.normal(size=(rank, 3)))


def _tip_field() -> TipField:
    axis = np.linspace(-0.1, 0.1, 9)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    distance = (np.sqrt(x**2 + y**2 + z**2) - RADIUS).astype(np.float32)
    spacing = axis[1] - axis[0]
    vertices, faces = ball()
    outline = Outline(vertices.astype(np.float32), faces.astype(np.int32))
    place = (np.full(3, axis[0]), np.array([spacing]))
    return TipField(distance, np.ones_like(distance), *place, outline=outline)


def _parametric(rng: np.random.Generator, vademecum: Vademecum) -> ParametricResponse:
    n, rank = len(vademecum.surface.centers), RANK + 2
    coordinate = Coordinate("poisson", 0.40, 0.48, 2)
    nodes = coordinate.n_nodes
    return ParametricResponse(
        coordinates=(coordinate,),
        basis=_field(rng, 3 * len(vademecum.mesh.vertices), 3 * n, rank),
        operators=np.tile(np.eye(rank), (2, 1, 1)),
        projection=1e-2 * rng.normal(size=(2, 2, rank)).astype(np.float32),
        regional_load=np.tile(vademecum.field.load[:, :, RANK:], (nodes, 1, 1, 1)),
        core=vademecum.field.core[:, :RANK],
        contact_near=np.tile(vademecum.contact_near.block, (nodes, 1, 1, 1)),
        n_global=RANK,
        rank=rank,
        young_modulus=vademecum.material.young_modulus,
        body=_body(rng, rank),
    )


def _large(rng: np.random.Generator, vademecum: Vademecum) -> LargeDeformation:
    n, powers = len(vademecum.surface.centers), len(POWERS)
    return LargeDeformation(
        "neo-hookean",
        _block_field(rng, vademecum.field.region, 2 * powers, 0),
        np.zeros((2, powers, n)),
        np.full((2, n), 0.01),
        LargeCertificate(0.02, 0.05, 0.01, 0.04, 0.1, 0.1, 3, 9, 0, 0.01, 0.01, 0.01),
    )
