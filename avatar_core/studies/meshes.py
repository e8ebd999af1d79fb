"""Meshes of real organs: their distance from the surface, element shapes, and cost.

For each surface, meshed like by `avatar vademecum`:

- volume: of the mesh over that inside the surface, less one;
- distance: of random points of the mesh's boundary from the surface, rms and worst, and worst of
  the surface's vertices from the mesh;
- least dihedral angle, and inverted elements;
- processor time of mesh and regions, fTetWild's process included;
- built again: whether a second mesh of the same surface is the same, bit for bit.

For their vademecums, built in full: certificates and processor time, and for some of them the error
of the mesh itself, by one refinement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import igl
import numpy as np

from avatar_core.common.processes import cpu_seconds
from avatar_core.geometry.mesh import TetMesh, quality, regions_by_rule, tetrahedralize
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.pipeline import OrganOptions, build
from avatar_core.studies.shapes import read_livers
from avatar_core.studies.study import Row, Run, Study, column, follow, label

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class MeshesSettings:
    """Numbers of livers: all, built in full, with measured mesh error, and meshed twice.

    None stands for all.

    n_vertices, n_certified : options of `avatar vademecum`
    n_points : points on each boundary
    """

    n_livers: int | None = None
    n_built: int | None = None
    n_refined: int = 5
    n_again: int = 5
    n_vertices: int = 2850
    n_certified: int = 200
    n_points: int = 20_000
    phantoms: int = 3


class MeshesStudy(Study[MeshesSettings]):
    """One row for each surface."""

    name = "meshes"
    full = MeshesSettings()
    quick = MeshesSettings(n_livers=6, n_built=0, n_refined=0, n_again=1)
    key = "liver"

    def measure(self, run: Run[MeshesSettings]) -> None:
        settings = run.settings
        livers = read_livers(run.surfaces, settings.n_livers, settings.phantoms)
        run.notices += livers.notices
        n = len(livers.surfaces)
        built, refined, again = (
            set(np.linspace(0, n - 1, n if chosen is None else min(chosen, n)).astype(int).tolist())
            for chosen in (settings.n_built, settings.n_refined, settings.n_again)
        )
        for i, surface in enumerate(follow(livers.surfaces, "livers")):
            if run.is_known(surface.name):
                continue
            row, mesh = _meshed(surface, settings)
            if i in again:
                row["same_again"] = _same(mesh, tetrahedralize(surface, settings.n_vertices))
            if i in built:
                row |= _certified(surface, settings, i in refined)
            run.add(row)

    def summary(self, run: Run[MeshesSettings]) -> dict[str, float]:
        def of(key: str) -> np.ndarray:
            return column(run.rows, key)

        found = {
            "n_vertices_least": of("n_vertices").min(),
            "n_vertices_most": of("n_vertices").max(),
            "volume_error_worst": np.abs(of("volume_error")).max(),
            "distance_rms_median_mm": np.median(of("distance_rms_mm")),
            "distance_rms_worst_mm": of("distance_rms_mm").max(),
            "min_dihedral_deg": of("min_dihedral_deg").min(),
            "n_inverted": of("n_inverted").sum(),
            "mesh_cpu_seconds_median": np.median(of("mesh_cpu_seconds")),
            "mesh_cpu_seconds_worst": of("mesh_cpu_seconds").max(),
            "same_again": of("same_again").mean(),
        }
        certified = ("l2_mean", "l2_worst", "contact_mean", "contact_worst")
        for key in (*certified, "mesh_l2", "mesh_contact", "build_cpu_seconds"):
            if len(values := of(key)):
                found |= {f"{key}_median": np.median(values), f"{key}_worst": values.max()}
        return {key: float(value) for key, value in found.items()}

    def sentence(self, run: Run[MeshesSettings]) -> str:
        summary = run.summary
        again = "the same" if summary["same_again"] == 1.0 else "another"
        return (
            f"Meshes of {len(run.rows)} livers lie within {summary['distance_rms_worst_mm']:.2f} "
            f"mm rms of the surface, hold its volume within {summary['volume_error_worst']:.1%}, "
            f"have no dihedral angle below {summary['min_dihedral_deg']:.1f} degrees, take "
            f"{summary['mesh_cpu_seconds_median']:.1f} s of processor time in the median, and "
            f"meshed again a surface gives {again} mesh."
        )

    def draw(self, figure: Figure, run: Run[MeshesSettings]) -> None:
        for axes, key, text, line in zip(
            figure.subplots(1, 3),
            ("distance_rms_mm", "min_dihedral_deg", "mesh_cpu_seconds"),
            ("boundary to surface, rms [mm]", "least dihedral angle [deg]", "processor time [s]"),
            (0.3, 5.0, 3.0),
            strict=True,
        ):
            axes.plot(column(run.rows, "n_vertices"), column(run.rows, key), "o", ms=4)
            axes.axhline(line, color="gray", ls=":", label=f"aim: {line:g}")
            axes.set_ylim(0.0, None)
            label(axes, "vertices of the mesh", text)


STUDY = MeshesStudy()


def _meshed(surface: SurfaceMesh, settings: MeshesSettings) -> tuple[Row, TetMesh]:
    """Return a row of the study, with units in its keys, and the mesh."""
    start = cpu_seconds()
    mesh = tetrahedralize(surface, settings.n_vertices)
    regions_by_rule(mesh)
    seconds = cpu_seconds() - start
    off = np.abs(surface.skin.signed_distance(_points_on(mesh, settings.n_points)))
    faces = mesh.boundary_faces.astype(np.int64)
    missed, _, _ = igl.point_mesh_squared_distance(surface.vertices, mesh.vertices, faces)
    shape = quality(mesh)
    row: Row = {
        "liver": surface.name,
        "n_vertices": len(mesh.vertices),
        "n_tets": len(mesh.tets),
        "volume_error": float(mesh.volume / surface.volume - 1.0),
        "distance_rms_mm": 1e3 * math.sqrt(float((off**2).mean())),
        "distance_worst_mm": 1e3 * float(off.max()),
        "missed_worst_mm": 1e3 * math.sqrt(float(missed.max())),
        "min_dihedral_deg": shape.min_dihedral,
        "n_inverted": int((mesh.tet_volumes <= 0.0).sum()),
        "mesh_cpu_seconds": seconds,
    }
    return row, mesh


def _points_on(mesh: TetMesh, n: int) -> np.ndarray:
    """Return the random points of the boundary, uniform over its area, shape (n, 3) [m]."""
    rng = np.random.default_rng(0)
    share = mesh.face_areas / mesh.face_areas.sum()
    face = mesh.boundary_faces[rng.choice(len(share), n, p=share)]
    corner = rng.dirichlet((1.0, 1.0, 1.0), n)
    return np.asarray(np.einsum("ij,ijk->ik", corner, mesh.vertices[face]))


def _same(one: TetMesh, other: TetMesh) -> bool:
    return np.array_equal(one.tets, other.tets) and np.array_equal(one.vertices, other.vertices)


def _certified(surface: SurfaceMesh, settings: MeshesSettings, refined: bool) -> Row:
    """Return relative errors of the vademecum's certificate, and its build's processor time [s].

    refined : measure the error of the mesh as well; the time then includes it and is left out
    """
    options = OrganOptions(
        n_vertices=settings.n_vertices, n_certified=settings.n_certified, with_mesh_error=refined
    )
    start = cpu_seconds()
    vademecum = build(surface, options)
    seconds = cpu_seconds() - start
    certificate = vademecum.certificate
    assert certificate is not None
    row: Row = {
        "modes": certificate.modes,
        "l2_mean": certificate.l2_mean,
        "l2_worst": certificate.l2_worst,
        "contact_mean": certificate.contact_mean,
        "contact_worst": certificate.contact_worst,
    }
    if refined:
        return row | {"mesh_l2": certificate.mesh_l2, "mesh_contact": certificate.mesh_contact}
    return row | {"build_cpu_seconds": seconds}
