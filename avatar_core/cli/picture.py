"""Pictures of an organ under a tool, drawn with matplotlib."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from avatar_core.certify.contact_sites import Site, hertz_force, nearest_sites, pressed
from avatar_core.contact.model import ContactData, model_of
from avatar_core.contact.tool_path import middle_of_access
from avatar_core.errors import ContactError, ConvergenceError, MeshError
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tip import Tip
from avatar_core.offline.resolved_contact import contacts_at
from avatar_core.scene.surface_export import displaced
from avatar_core.vademecum.model import Vademecum

TIP = Tip("sphere", 5e-3)
PUSH = 2.0  # of the first picture: it deforms the phantom visibly [N]
RESOLVED = (1e-3, 2e-3, 3e-3, 4e-3, 5e-3)  # depths at which contact is resolved [m]


@dataclass(frozen=True)
class ForceCurve:
    """Normal forces on ``TIP`` at one place, over its depth.

    depth : ndarray, shape (n,) [m]
    force, error, hertz : ndarray, shape (n,), of the step, its estimated error, and of a half-space
        [N]
    resolved : ndarray, shape (len(RESOLVED),), of resolved contact [N]; None without one
    """

    depth: np.ndarray
    force: np.ndarray
    error: np.ndarray
    hertz: np.ndarray
    resolved: np.ndarray | None

    def misses(self, force: np.ndarray) -> float:
        """Return the largest relative difference of some forces from the resolved ones."""
        assert self.resolved is not None
        found = np.interp(RESOLVED, self.depth, force)
        return float(np.abs(found / self.resolved - 1.0).max())


def response_picture(vademecum: Vademecum, path: str | Path) -> None:
    """Draw the organ under ``PUSH`` in the middle of its accessible surface, without any contact.

    Only the vademecum is evaluated, :meth:`Vademecum.displacement_at`, so nothing is compiled.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    point = vademecum.surface.centers[middle_of_access(vademecum)]
    points = displaced(vademecum, vademecum.displacement_at(point, PUSH))
    cloud = np.hstack([points, points - vademecum.surface_vertices])
    figure = plt.figure(figsize=(6, 4.8), layout="constrained")
    _draw_organ(figure.add_subplot(), vademecum, cloud, point)
    figure.suptitle(f"A push of {PUSH:g} N on a patch, from the vademecum alone")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def palpation_picture(
    vademecum: Vademecum,
    surface: SurfaceMesh,
    path: str | Path,
    progress: Callable[[float], None] | None = None,
) -> None:
    """Draw the organ under a push in the middle of its accessible surface, and the force there.

    Left: deformed boundary seen from the front, coloured by displacement. Right: normal force over
    depth by the 1 kHz step, on a half-space (Hertz 1882), and by resolved contact.

    surface : surface that the vademecum was built from
    progress : called with the finished fraction of the resolved contact
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    middle = vademecum.surface.centers[[middle_of_access(vademecum)]]
    (site,) = nearest_sites(vademecum, surface, middle)
    data = model_of(vademecum, (TIP,)).data()
    curve = force_curve(vademecum, surface, site, data, progress)
    figure = plt.figure(figsize=(12, 4.8), layout="constrained")
    _draw_organ(figure.add_subplot(1, 2, 1), vademecum, data.out.cloud, site.point)
    _draw_curve(figure, curve)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def force_curve(
    vademecum: Vademecum,
    surface: SurfaceMesh,
    site: Site,
    data: ContactData,
    progress: Callable[[float], None] | None = None,
) -> ForceCurve:
    """Return the forces at a place; the data are left at the largest depth."""
    depth = np.linspace(0.0, max(RESOLVED), 51)
    force, error = np.empty_like(depth), np.empty_like(depth)
    for k, at in enumerate(depth):
        force[k] = np.linalg.norm(pressed(data, site, TIP, at))
        error[k] = data.out.force_error[0]
    hertz = hertz_force(vademecum.material, TIP.radius, depth)
    return ForceCurve(depth, force, error, hertz, _resolved(vademecum, surface, site, progress))


def _resolved(
    vademecum: Vademecum, surface: SurfaceMesh, site: Site, progress: Callable[[float], None] | None
) -> np.ndarray | None:
    """Return forces of resolved contact at ``RESOLVED``; None where the mesh does not allow it."""
    organ = (surface, vademecum.mesh, vademecum.regions, vademecum.material)
    place = (site.point, site.normal, (TIP,), RESOLVED)
    try:
        return contacts_at(*organ, *place, progress=progress).forces[0]
    except (MeshError, ContactError, ConvergenceError) as error:
        print(f"notice: the picture is without resolved contact: {error}", file=sys.stderr)
        return None


def _draw_organ(axes, vademecum: Vademecum, cloud: np.ndarray, tip: np.ndarray) -> None:  # type: ignore[no-untyped-def]
    faces = vademecum.organ_faces
    corner = cloud[faces]
    front = np.argsort(corner[:, :, 1].mean(axis=1))  # painter's order, seen from anterior
    seen = np.cross(corner[:, 1, :3] - corner[:, 0, :3], corner[:, 2, :3] - corner[:, 0, :3])
    front = front[seen[front, 1] > 0]
    light = seen[front] / np.linalg.norm(seen[front], axis=1, keepdims=True)
    moved = 1e3 * np.linalg.norm(corner[front, :, 3:], axis=2).mean(axis=1)
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import Normalize

    scale = ScalarMappable(Normalize(0.0, moved.max()), "viridis")
    color = scale.to_rgba(moved)
    color[:, :3] *= (0.55 + 0.45 * np.clip(light @ np.array([-0.4, 0.75, 0.5]), 0, 1))[:, None]
    flat = np.stack([corner[front, :, 0], corner[front, :, 2]], axis=2) * 1e3
    axes.add_collection(
        PolyCollection(list(flat), facecolors=color, edgecolors="face", linewidths=0.2)
    )
    axes.plot(tip[0] * 1e3, tip[2] * 1e3, "o", ms=9, mfc="none", mec="crimson", mew=2)
    axes.autoscale_view()
    axes.invert_xaxis()  # radiological view: the patient's right is on the viewer's left
    axes.set_aspect("equal")
    axes.set_xlabel("patient's right    x [mm]    patient's left")
    axes.set_ylabel("z, superior [mm]")
    axes.set_title(f"{vademecum.name}: deformed organ, tool tip circled")
    axes.figure.colorbar(scale, ax=axes, label="displacement [mm]", shrink=0.8)


def _draw_curve(figure, curve: ForceCurve) -> None:  # type: ignore[no-untyped-def]
    axes = figure.add_subplot(1, 2, 2)
    depth, force = 1e3 * curve.depth, curve.force
    axes.plot(depth, force, lw=2, color="C0", label="avatar, one step for each depth")
    axes.fill_between(
        depth,
        force - curve.error,
        force + curve.error,
        alpha=0.25,
        color="C0",
        lw=0,
        label="estimated error of the step",
    )
    axes.plot(depth, curve.hertz, "--", lw=1.5, color="gray", label="Hertz, on a half-space")
    if curve.resolved is not None:
        axes.plot(
            1e3 * np.array(RESOLVED), curve.resolved, "o", color="crimson", label="resolved contact"
        )
    axes.set_xlim(left=0.0)
    axes.set_ylim(bottom=0.0)
    axes.set_xlabel("depth of the tip [mm]")
    axes.set_ylabel("force [N]")
    axes.set_title(_sentence(curve))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", fontsize=9)


def _sentence(curve: ForceCurve) -> str:
    tip = f"a {TIP.shape} of {1e3 * TIP.radius:g} mm radius"
    if curve.resolved is None:
        return f"The force on {tip}, pressed in at the circled place"
    step, hertz = (100 * curve.misses(force) for force in (curve.force, curve.hertz))
    return (
        f"On {tip}, the step misses resolved contact\n"
        f"by at most {step:.1f} %, Hertz by up to {hertz:.0f} %."
    )
