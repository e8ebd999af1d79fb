"""Contact: the force of a real tip against resolved contact, Hertz, and the vademecum's own patch.

Spheres of 1.5 to 10 mm, a cone and a punch press 1 to 5 mm deep. Places are drawn over each liver,
a ridge and a hollow among them, and at its thinnest edges. The truth is Signorini's contact on the
same organ, resolved (:mod:`avatar_core.offline.resolved_contact`). It is itself compared with
Sneddon's exact sphere on a box. None of the livers was used to calibrate the step's error estimate.
Some livers are also given turned, and meshed more coarsely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from skfem import MeshTet

from avatar_core.certify.contact_sites import (
    SiteContact,
    contacts_at_sites,
    draw_sites,
    edge_sites,
    summarized,
)
from avatar_core.fem.elasticity import Material
from avatar_core.fem.signorini import half_space_radius
from avatar_core.geometry.mesh import Regions, make_mesh
from avatar_core.geometry.surface import SurfaceMesh, read_surface
from avatar_core.geometry.tip import Tip
from avatar_core.offline.resolved_contact import DEPTHS, contacts_at
from avatar_core.offline.rule import BuildRule
from avatar_core.pipeline import OrganOptions, build
from avatar_core.studies.invariance import differences
from avatar_core.studies.shapes import DEFAULT_FOLDER
from avatar_core.studies.study import Row, Run, Study, follow

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TIPS = (
    *(Tip("sphere", radius) for radius in (1.5e-3, 3e-3, 5e-3, 7e-3, 10e-3)),
    Tip("cone", 8e-3, half_angle=60.0),
    Tip("flat", 3e-3),
)
KINDS = ("drawn", "ridge", "hollow", "edge")
LIVERS = ("LiTS-20", "LiTS-50", "Amos-052", "Amos-086")  # other livers than in the calibration


@dataclass(frozen=True)
class ContactSettings:
    """Sizes of the study.

    They are livers by name, places and edges on each, tips and depths [m]. A ball is pressed at
    further places on the ``invariant`` livers, which are also turned and remeshed.
    """

    livers: tuple[str, ...] = LIVERS
    n_places: int = 6
    n_edges: int = 2
    tips: tuple[Tip, ...] = TIPS
    depths: tuple[float, ...] = DEPTHS
    options: OrganOptions = field(default_factory=OrganOptions)
    invariant: tuple[str, ...] = LIVERS[:2]
    n_invariant: int = 100


class ContactStudy(Study[ContactSettings]):
    """One row for each contact; the folder must hold the livers by their names."""

    name = "contact"
    full = ContactSettings()
    quick = ContactSettings(
        livers=LIVERS[:1],
        n_places=3,
        n_edges=1,
        options=OrganOptions(rule=BuildRule(max_modes=60), n_certified=40),
        invariant=(),
    )

    def measure(self, run: Run[ContactSettings]) -> None:
        folder = run.surfaces or DEFAULT_FOLDER
        livers = [read_surface(folder / f"{name}.obj") for name in run.settings.livers]
        contacts: list[SiteContact] = []
        for liver in livers:
            found = contacts_of(liver, run.settings, run.notices)
            contacts += found
            for contact in found:
                run.add(_row(liver.name, contact))
        run.kept["contacts"] = contacts
        run.kept["invariance"] = {
            f"{name}_{key}": value
            for name in follow(run.settings.invariant, "turned and coarser")
            for key, value in differences(
                read_surface(folder / f"{name}.obj"), run.settings.options, run.settings.n_invariant
            ).items()
        }

    def summary(self, run: Run[ContactSettings]) -> dict[str, float]:
        found = {**summary_of(run.kept["contacts"]), **run.kept["invariance"]}
        return {**found, "reference_vs_sneddon": reference_error()}

    def sentence(self, run: Run[ContactSettings]) -> str:
        summary = run.summary
        return (
            f"On {len(run.rows)} resolved contacts the mean error of the force is "
            f"{summary['force_mean']:.1%}, for 95 % of them below {summary['force_p95']:.1%}, "
            f"at worst {summary['force_worst']:.1%}; the patch alone misses "
            f"{summary['patch_mean']:.0%}, Hertz on a half-space {summary['hertz_mean']:.0%}. "
            f"The estimated error covers {summary['coverage']:.0%}."
        )

    def draw(self, figure: Figure, run: Run[ContactSettings]) -> None:
        left, right = figure.subplots(1, 2)
        contacts: list[SiteContact] = run.kept["contacts"]
        _draw_depths(left, contacts)
        colours = ("steelblue", "crimson", "seagreen", "darkorange")
        for kind, colour in zip(KINDS, colours, strict=True):
            own = [contact for contact in contacts if contact.site.kind == kind]
            truth = [contact.truth for contact in own]
            ratio = [contact.force / contact.truth for contact in own]
            right.semilogx(truth, ratio, "o", ms=3, color=colour, label=kind)
        right.axhspan(0.9, 1.1, color="gray", alpha=0.15)
        right.set(xlabel="resolved force [N]", ylabel="force / resolved force")
        right.set_title("all contacts; grey: within 10 %")
        right.legend()


STUDY = ContactStudy()


def contacts_of(
    surface: SurfaceMesh, settings: ContactSettings, notices: list[str]
) -> list[SiteContact]:
    """Return all contacts on one liver; a notice counts contacts that could not be resolved."""
    vademecum = build(surface, settings.options)
    places = draw_sites(vademecum, surface, settings.n_places, seed=7)
    places += edge_sites(vademecum, surface, settings.n_edges, seed=7)
    sites = follow(places, f"{surface.name}: places")
    contacts, missing = contacts_at_sites(vademecum, surface, sites, settings.tips, settings.depths)
    notices += [f"{surface.name}, contact sites: {notice}" for notice in missing]
    return contacts


def reference_error() -> float:
    """Return the reference's worst relative error for a sphere of 3 mm, 1 and 2 mm deep in a cube.

    It is compared with Sneddon's half-space; the cube of 200 mm is clamped at its bottom.
    """
    tip, depths, material = Tip("sphere", 3e-3), (1e-3, 2e-3), Material()
    ticks = np.linspace(0.0, 0.2, 5)
    cube = MeshTet.init_tensor(ticks, ticks, ticks)
    mesh = make_mesh(cube.p.T.copy(), cube.oriented().t.T.copy())
    height = mesh.vertices[mesh.boundary_faces][:, :, 2]
    regions = Regions((height < 1e-9).all(axis=1), (height > 0.2 - 1e-9).all(axis=1))
    top, up = np.array([0.1, 0.1, 0.2]), np.array([0.0, 0.0, 1.0])
    found = contacts_at(None, mesh, regions, material, top, up, (tip,), depths).forces[0]
    exact = np.array([sneddon(tip, material, depth) for depth in depths])
    return float(np.abs(found / exact - 1.0).max())


def sneddon(tip: Tip, material: Material, depth: float) -> float:
    """Return the force on a sphere in a half-space (Sneddon 1965) [N]."""
    a, r = half_space_radius(tip, depth), tip.radius
    stiffness = material.plane_strain_modulus
    return float(stiffness * (0.5 * (a * a + r * r) * np.log((r + a) / (r - a)) - a * r))


def summary_of(contacts: Sequence[SiteContact]) -> dict[str, float]:
    """Return key figures; errors are those of the force along the resolved force, relative."""
    found = summarized(contacts)
    patch = np.array([abs(contact.patch / contact.truth - 1.0) for contact in contacts])
    hertz = np.array([abs(contact.hertz / contact.truth - 1.0) for contact in contacts])
    return {
        "contacts": float(found.n_contacts),
        "force_mean": found.mean,
        "force_p95": found.p95,
        "force_worst": found.worst,
        "far_field_l2": float(max(contact.far_l2 for contact in contacts)),
        "far_field_l2_mean": float(np.mean([contact.far_l2 for contact in contacts])),
        "far_field_l2_median": float(np.median([contact.far_l2 for contact in contacts])),
        "direction_mean_deg": float(np.degrees(np.mean([contact.angle for contact in contacts]))),
        "coverage": found.coverage,
        "median_overestimate": found.overestimate,
        "patch_mean": float(patch.mean()),
        "hertz_mean": float(np.nanmean(hertz)),
        **{
            f"{group}_{key}": value
            for group, own in _groups(contacts).items()
            for key, value in _figures(own).items()
        },
    }


def _groups(contacts: Sequence[SiteContact]) -> dict[str, list[SiteContact]]:
    """Return spheres by the kind of their place, and other tips by their shape; none is empty."""
    spheres = [contact for contact in contacts if contact.tip.shape == "sphere"]
    groups = {kind: [c for c in spheres if c.site.kind == kind] for kind in KINDS}
    groups |= {s: [c for c in contacts if c.tip.shape == s] for s in ("cone", "flat")}
    return {name: own for name, own in groups.items() if own}


def _figures(contacts: Sequence[SiteContact]) -> dict[str, float]:
    found = summarized(contacts)
    return {
        "contacts": float(found.n_contacts),
        "mean": found.mean,
        "p95": found.p95,
        "worst": found.worst,
        "coverage": found.coverage,
        "overestimate": found.overestimate,
    }


def _row(name: str, contact: SiteContact) -> Row:
    site = contact.site
    return {
        "liver": name,
        "place": site.kind,
        "kappa_per_m": site.kappa,
        "tip": contact.tip.shape,
        "radius_m": contact.tip.radius,
        "depth_m": contact.depth,
        "true_n": contact.truth,
        "force_n": contact.force,
        "angle_rad": contact.angle,
        "said_error_n": contact.estimate,
        "patch_n": contact.patch,
        "hertz_n": contact.hertz,
        "far_l2": contact.far_l2,
    }


def _draw_depths(axes: Axes, contacts: Sequence[SiteContact]) -> None:
    """Draw force over depth at the first place, for the smallest and the largest sphere."""
    first = [c for c in contacts if c.site is contacts[0].site and c.tip.shape == "sphere"]
    radii = sorted({contact.tip.radius for contact in first})
    for radius, colour in ((radii[0], "crimson"), (radii[-1], "steelblue")):
        own = sorted((c for c in first if c.tip.radius == radius), key=lambda c: c.depth)
        depth = [1e3 * contact.depth for contact in own]
        for name, text, style in (
            ("truth", "resolved", "o"),
            ("force", "step", "-"),
            ("hertz", "Hertz", ":"),
            ("patch", "patch", "--"),
        ):
            force = [getattr(contact, name) for contact in own]
            label = f"{text}, R {1e3 * radius:g} mm"
            axes.plot(depth, force, style, color=colour, label=label)
    axes.set(xlabel="depth [mm]", ylabel="force [N]", title="one place")
    axes.legend(fontsize=8)
