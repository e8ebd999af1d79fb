"""Grasp: the pull of a jaw against a resolved disc of tissue, bonded and moved by finite elements.

At places drawn over each liver, a ridge and a hollow among them, discs are pulled along the normal,
along the surface and between. The truth is the same organ, refined there
(:mod:`avatar_core.fem.bonded_disc`), at small strains. Rivals: the vademecum's patch without the
disc, and the disc on a half-space, as if the organ beyond did not give way.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from avatar_core.certify.contact_sites import Site, draw_sites
from avatar_core.common.arrays import FloatArray
from avatar_core.contact.model import ContactData, estimate_error, model_of, step
from avatar_core.errors import AvatarError
from avatar_core.fem.bonded_disc import BondedDisc, bonded_disc
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.point_location import carriers
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.geometry.tip import Jaw, Tip
from avatar_core.offline.resolved_contact import Resolution, refined_organ
from avatar_core.offline.rule import BuildRule
from avatar_core.pipeline import OrganOptions, build
from avatar_core.studies.shapes import DEFAULT_FOLDER
from avatar_core.studies.study import Row, Run, Study, column, follow
from avatar_core.vademecum.model import Vademecum

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ANGLES = (0.0, 45.0, 90.0)  # of a pull off the normal [degrees]
PULL = 2e-3  # [m]
FAR = 15e-3  # from the jaw, beyond which the displacement is compared [m]
TIP_RADIUS = 5e-3  # of the tool that carries the jaw [m]
_ABOVE = 0.2e-3  # of a jaw that closes over the surface [m]
_RESOLUTION = Resolution(core=0.2)
_RIVALS = (("error", "jaw"), ("patch_error", "patch alone"), ("disc_error", "disc on a half-space"))


@dataclass(frozen=True)
class GraspSettings:
    """Livers by name, none for the phantom; places on each; radii of the jaws [m]."""

    livers: tuple[str, ...] = ("LiTS-20", "Amos-052")
    n_places: int = 6
    radii: tuple[float, ...] = (2e-3, 5e-3)
    options: OrganOptions = field(default_factory=OrganOptions)


class GraspStudy(Study[GraspSettings]):
    """One row for each pull."""

    name = "grasp"
    full = GraspSettings()
    quick = GraspSettings(
        livers=(),
        n_places=2,
        radii=(3e-3,),
        options=OrganOptions(n_vertices=1200, rule=BuildRule(max_modes=80), n_certified=20),
    )

    def measure(self, run: Run[GraspSettings]) -> None:
        settings, folder = run.settings, run.surfaces or DEFAULT_FOLDER
        organs = [read_surface(folder / f"{name}.obj") for name in settings.livers]
        for organ in organs or [phantom_liver()]:
            vademecum = build(organ, settings.options)
            sites = draw_sites(vademecum, organ, settings.n_places, seed=11)
            for site in follow(sites, f"{organ.name}: places"):
                for radius in settings.radii:
                    try:
                        rows = list(pulls_at(vademecum, organ, site, radius))
                    except AvatarError as error:
                        run.notices.append(f"{organ.name}, {site.kind}: {error}")
                        continue
                    for row in rows:
                        run.add(row)

    def summary(self, run: Run[GraspSettings]) -> dict[str, float]:
        rows = run.rows
        found = {"pulls": float(len(rows))}
        for key, _ in _RIVALS:
            found[f"force_{key}_mean"] = float(column(rows, key).mean())
            found[f"force_{key}_worst"] = float(column(rows, key).max())
        return found | {
            "force_p95": float(np.quantile(column(rows, "error"), 0.95)),
            "coverage": float(column(rows, "covered").mean()),
            "overestimate_median": float(
                np.median(column(rows, "estimate") / column(rows, "error"))
            ),
            "far_field_l2_mean": float(column(rows, "far_l2").mean()),
            "far_field_l2_worst": float(column(rows, "far_l2").max()),
        }

    def sentence(self, run: Run[GraspSettings]) -> str:
        found = run.summary
        return (
            f"Of {found['pulls']:.0f} pulls on a bonded disc the force misses "
            f"{found['force_error_mean']:.1%} in the mean, {found['force_error_worst']:.1%} at "
            f"worst (patch alone {found['force_patch_error_mean']:.0%}, disc on a half-space "
            f"{found['force_disc_error_mean']:.0%}), the displacement beyond "
            f"{1e3 * FAR:.0f} mm {found['far_field_l2_mean']:.1%} and "
            f"{found['far_field_l2_worst']:.1%}; the error that is said covers "
            f"{found['coverage']:.0%}."
        )

    def draw(self, figure: Figure, run: Run[GraspSettings]) -> None:
        left, right = figure.subplots(1, 2)
        for angle, colour in zip(ANGLES, ("steelblue", "seagreen", "crimson"), strict=True):
            own = [row for row in run.rows if row["angle"] == angle]
            ratio = column(own, "force") / column(own, "truth")
            left.plot(column(own, "truth"), ratio, "o", ms=4, color=colour, label=f"{angle:.0f}°")
        left.axhspan(0.94, 1.06, color="gray", alpha=0.15)
        left.set(xlabel="resolved force along the pull [N]", ylabel="force / resolved force")
        left.set_title(f"pulls of {1e3 * PULL:g} mm, by their angle off the normal; grey: 6 %")
        left.legend()
        values = [100.0 * column(run.rows, key) for key, _ in _RIVALS]
        right.boxplot(values, tick_labels=[label for _, label in _RIVALS], whis=(0, 100))
        right.set(ylabel="error of the force [%]", yscale="log")


STUDY = GraspStudy()


def pulls_at(vademecum: Vademecum, organ: SurfaceMesh, site: Site, radius: float) -> Iterator[Row]:
    """Yield a row for each angle, of one jaw at one place."""
    normal = site.normal / np.linalg.norm(site.normal)
    flat = Tip("flat", radius)
    resolved = refined_organ(
        organ, vademecum.mesh, vademecum.regions, vademecum.material, [site.point], [normal],
        (flat,), (1e-3,), _RESOLUTION,
    )  # fmt: skip
    disc = bonded_disc(resolved, site.point, normal, radius)
    corners, weights = carriers(resolved.mesh, vademecum.mesh.vertices)
    moved = np.einsum("nk,nkda->nda", weights, disc.displacement[corners])
    data, start = held_at(vademecum, site.point, normal, radius)
    aside = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    aside /= np.linalg.norm(aside)
    far = np.linalg.norm(vademecum.mesh.vertices - site.point, axis=1) > FAR
    volume = far * vademecum.mesh.vertex_volumes
    for angle in ANGLES:
        turn = np.radians(angle)
        pull = PULL * (np.cos(turn) * normal + np.sin(turn) * aside)
        step(data.model, data, (start + pull)[None])
        estimate_error(data.model, data)
        force, truth = -data.out.force[0], disc.stiffness @ pull
        size, true = float(np.linalg.norm(truth)), moved @ pull
        off = data.out.cloud[:, 3:] - true
        error = float(np.linalg.norm(force - truth)) / size
        estimate = float(data.out.force_error[0]) / size
        row: Row = {
            "organ": organ.name,
            "kind": site.kind,
            "radius_mm": 1e3 * radius,
            "angle": angle,
            "truth": float(truth @ pull) / PULL,
            "force": float(force @ pull) / PULL,
            "error": error,
            "estimate": estimate,
            "covered": error <= estimate,
            "far_l2": float(np.sqrt(volume @ (off**2).sum(1) / (volume @ (true**2).sum(1)))),
        }
        yield row | _rivals(vademecum, data, disc, pull, radius)


def held_at(
    vademecum: Vademecum, place: FloatArray, normal: FloatArray, radius: float
) -> tuple[ContactData, FloatArray]:
    """Return a tool whose jaw has just closed at a place, and where it is [m]."""
    tip = Tip("sphere", TIP_RADIUS, grasp=Jaw(radius, 100.0))
    data = model_of(vademecum, (tip,), cloud="volume").data()
    start = place + normal * (TIP_RADIUS + _ABOVE)
    step(data.model, data, start[None], None, np.array([False]))
    step(data.model, data, start[None], None, np.array([True]))
    return data, start


def _rivals(
    vademecum: Vademecum, data: ContactData, disc: BondedDisc, pull: FloatArray, radius: float
) -> Row:
    """Return the errors of the force by the patch alone, and by the disc on a half-space."""
    state, truth = data.state, disc.stiffness @ pull
    nodes, weights = state.nodes[0, : state.n_nodes[0]], state.weight[0, : state.n_nodes[0], 0]
    patch = np.linalg.solve(vademecum.compliance(nodes, weights), pull)
    normal, nu = state.normal[0], vademecum.material.poisson_ratio
    give = 0.5 / (vademecum.material.plane_strain_modulus * radius)
    along = (pull @ normal) * normal
    alone = along / give + (pull - along) / (give * (2.0 - nu) / (2.0 * (1.0 - nu)))
    size = np.linalg.norm(truth)
    return {
        "patch_error": float(np.linalg.norm(patch - truth) / size),
        "disc_error": float(np.linalg.norm(alone - truth) / size),
    }
