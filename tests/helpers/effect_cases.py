"""What the tests of effects share: the choices, a path over the organ, full finite elements."""

from __future__ import annotations

import numpy as np
from skfem import Basis, BilinearForm, ElementTetP1, ElementTetP2, ElementVector, MeshTet
from skfem.helpers import dot

from avatar_core.contact.effects import (
    Effect,
    Friction,
    Inertia,
    Respiration,
    SelfWeight,
    SeveralTools,
    Viscoelasticity,
)
from avatar_core.contact.model import ContactModel, step
from avatar_core.contact.tool_path import middle_of_access
from avatar_core.fem.elasticity import Elasticity
from avatar_core.geometry.tip import Tip
from avatar_core.vademecum.model import Vademecum

TIP = 10e-3
SPHERE, PATCH = Tip("sphere", TIP), Tip("patch", TIP)
CHOICES: dict[str, Effect] = {
    effect.name: effect
    for effect in (
        SeveralTools(),
        Friction(),
        Viscoelasticity((0.3, 0.2), (0.05, 1.0)),
        Inertia(),
        SelfWeight(),
        Respiration(period=0.5),
    )
}


def push_and_drag(v: Vademecum, n: int = 60) -> np.ndarray:
    """Into the organ and along it, shape (n, 3)."""
    j = middle_of_access(v)
    center, normal = v.surface.centers[j], v.surface.normals[j]
    along = np.linalg.svd(normal[None])[2][1]
    t = np.linspace(0.0, 1.0, n)[:, None]
    return center + (TIP - 6e-3 * np.minimum(2 * t, 1.0)) * normal + 4e-3 * t * along


def forces(model: ContactModel, path: np.ndarray) -> np.ndarray:
    """Forces on the first tool where all tools go along one path, shape (n, 3)."""
    model.reset()
    out = np.empty(path.shape)
    for tips, force in zip(np.repeat(path[:, None], model.n_tools, axis=1), out, strict=True):
        step(model, tips)
        force[:] = model.out.force[0]
    return out


@BilinearForm
def density(u, v, w):  # type: ignore[no-untyped-def]
    return dot(u, v)


def elasticity_of(v: Vademecum) -> Elasticity:
    return Elasticity(v.mesh, v.material, v.regions.clamped, v.element)


def full_sag(v: Vademecum, rho: float) -> np.ndarray:
    """Full finite elements under 1 m/s^2 along each axis, at all nodes (3 n_nodes, 3)."""
    elasticity = elasticity_of(v)
    mesh = MeshTet(v.mesh.vertices.T.copy(), v.mesh.tets.T.copy())
    shape = ElementTetP1() if v.element == "P1" else ElementTetP2()
    basis = Basis(mesh, ElementVector(shape), intorder=4)
    order = np.concatenate([basis.nodal_dofs.T.ravel(), basis.edge_dofs.T.ravel()])
    mass = rho * density.assemble(basis).tocsr()[order][:, order]
    return np.asarray(elasticity.solve(mass @ np.tile(np.eye(3), (elasticity.n_nodes, 1))))
