"""Offline accuracy against time: size of the mesh.

Each row has an error, its kind, and its CPU seconds.
"""

from __future__ import annotations

import time

from avatar_core.certify.linear import mesh_error
from avatar_core.fem.elasticity import Elasticity
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.pipeline import OrganOptions, build
from avatar_core.studies.study import Row, follow


def mesh_rows(surface: SurfaceMesh, sizes: tuple[int, ...]) -> list[Row]:
    """Return vademecums on meshes of several sizes: the change by refinement, and the build.

    The error is the mesh's, not the vademecum's, which is alike at every size.
    """
    rows: list[Row] = []
    for n in follow(sizes, "mesh size"):
        start = time.process_time()
        built = build(surface, OrganOptions(n_vertices=n, n_certified=40))
        seconds = time.process_time() - start
        elasticity = Elasticity(built.mesh, built.material, built.regions.clamped, built.element)
        l2, contact = mesh_error(built, elasticity, n_loads=3)
        assert built.certificate is not None
        rows.append(
            {
                "stage": "mesh",
                "method": "vademecum",
                "setting": f"{len(built.mesh.vertices)} vertices",
                "error": float(l2),
                "cpu_seconds": float(seconds),
                "size": len(built.mesh.vertices),
                "contact_error": contact,
                "vademecum_error": built.certificate.l2_mean,
                "modes": built.far.rank,
            }
        )
    return rows
