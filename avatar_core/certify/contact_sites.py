"""Contacts of real tips against resolved ones, at some places of an organ.

The step presses spheres of several radii to several depths. The reference is Signorini's contact of
the same sphere in the same pose with the organ itself. Its mesh resolves the contact and lies on
the surface that was read (:mod:`avatar_core.offline.resolved_contact`).

The step's error estimate is e_patch + e_law. On an organ with resolved contacts, e_law is
multiplied by the factor with which e_patch + factor e_law covers nine in ten of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import igl
import numpy as np

from avatar_core.certify.unseen_contacts import draw_contacts
from avatar_core.common.splines import evaluate
from avatar_core.contact.model import ContactData, Status, estimate_error, model_of, step
from avatar_core.errors import ContactError, ConvergenceError, MeshError
from avatar_core.fem.norms import relative_l2
from avatar_core.geometry.heights import tangents
from avatar_core.geometry.tip import Tip
from avatar_core.offline.resolved_contact import DEPTHS, SPHERES, contacts_at
from avatar_core.offline.rule import NO_ERROR, Progress, silent
from avatar_core.tips.law import law_error
from avatar_core.vademecum.certificate import Certificate, ContactSites
from avatar_core.vademecum.force_error import PROMISED

if TYPE_CHECKING:
    from avatar_core.fem.elasticity import Material
    from avatar_core.geometry.surface import SurfaceMesh
    from avatar_core.vademecum.model import Vademecum

DRAWN = 60  # places among which the sharpest and the most hollow one are found
FITS = 1e-3  # overlap of a tip and the hollow around the place, above which it is left out [m]
OPEN = 0.99  # access at the largest depth, below which the force fades
FAR = 15e-3  # distance from the place beyond which displacements are compared [m]
ASIDE = 4e-3  # distance from a place at which the surface's normals give its curvature [m]
THIN = 25e-3  # thickness of an organ at its edges [m]
TINY = 1e-12  # [N]
_MANY_DRAWN = 400  # places among which the thinnest ones are found
_SKIN = 1e-4  # below a surface, from where the other side is looked for [m]
LEAST_FACTOR = 0.5  # factor on the law's error: a few lucky places prove no more


@dataclass(frozen=True, eq=False)
class Site:
    """A place on the organ's surface.

    Attributes
    ----------
    kind : str
        "drawn", "ridge", "hollow" or "edge".
    point : ndarray, shape (3,)
        Point [m].
    normal : ndarray, shape (3,)
        Outward unit normal.
    kappa : float
        Mean curvature over ``ASIDE``, positive where convex [1/m].
    """

    kind: str
    point: np.ndarray
    normal: np.ndarray
    kappa: float


@dataclass(frozen=True)
class SiteContact:
    """One contact: a tip at a depth at a site; forces along the resolved force [N].

    Attributes
    ----------
    truth, force : float
        Forces of the resolved contact and of the step [N].
    angle : float
        Angle between both forces [rad].
    estimate, law_estimate : float
        Estimated relative error of the force, and the law's part of it.
    patch : float
        Force of the vademecum's own patch [N].
    hertz : float
        Force of a sphere on a flat half-space (Hertz 1882), NaN for another tip [N].
    far_l2 : float
        Relative L2 error of the displacement more than 15 mm away.
    """

    site: Site
    tip: Tip
    depth: float
    truth: float
    force: float
    angle: float
    estimate: float
    law_estimate: float
    patch: float
    hertz: float
    far_l2: float

    @property
    def error(self) -> float:
        """Relative error of the force."""
        return abs(self.force / self.truth - 1.0)


def with_contact_sites(
    vademecum: Vademecum, surface: SurfaceMesh, n: int, seed: int, progress: Progress = silent
) -> Vademecum:
    """Return the vademecum, its certificate with errors against resolved contacts at ``n`` places.

    A notice of the provenance counts the contacts that could not be resolved.
    """
    sites = draw_sites(vademecum, surface, n, seed)
    contacts, notices = contacts_at_sites(vademecum, surface, _reported(sites, progress))
    if len(sites) < n:
        notices.insert(0, f"only {len(sites)} of {n} places are far enough from the border")
    found = summarized(contacts, law_factor(contacts))
    certificate = replace(vademecum.certificate or Certificate.unknown(), contact_sites=found)
    said = (f"contact sites: {notice}" for notice in notices)
    return vademecum.with_certificate(certificate).with_notices(*said)


def _reported(sites: Sequence[Site], progress: Progress) -> Iterator[Site]:
    for k, site in enumerate(sites):
        progress("contacts", k / len(sites), NO_ERROR)
        yield site
    progress("contacts", 1.0, NO_ERROR)


def contacts_at_sites(
    vademecum: Vademecum,
    surface: SurfaceMesh,
    sites: Iterable[Site],
    tips: Sequence[Tip] = SPHERES,
    depths: Sequence[float] = DEPTHS,
) -> tuple[list[SiteContact], list[str]]:
    """Return the contacts of all sites, and notices that count missing ones.

    Places that the reference cannot resolve, and poses that the step refuses, are left out.
    """
    contacts: list[SiteContact] = []
    lost: list[str] = []
    models = [_Models.of(vademecum, tip) for tip in tips]
    for site in sites:
        try:
            contacts += compared(vademecum, surface, site, models, depths)
        except (MeshError, ContactError, ConvergenceError) as error:
            lost.append(f"a {site.kind} place: {error}")
    felt = [contact for contact in contacts if np.isfinite(contact.force)]
    notices = []
    if lost:
        notices.append(f"left out {len(lost)} that could not be resolved; the first, {lost[0]}")
    if len(felt) < len(contacts):
        notices.append(f"left out {len(contacts) - len(felt)} poses that the step refused")
    return felt, notices


def law_factor(contacts: Sequence[SiteContact]) -> float:
    """Return the least factor on the law's error that covers ``PROMISED`` of the contacts.

    The factor comes from split conformal prediction, like in
    :mod:`avatar_core.vademecum.force_error`. It is at least ``LEAST_FACTOR``, and 1 without any
    contact.
    """
    if not contacts:
        return 1.0
    needed = sorted(
        1.0 + (abs(c.force - c.truth) - c.estimate) / max(c.law_estimate, TINY) for c in contacts
    )
    rank = min(int(np.ceil(PROMISED * (len(needed) + 1))), len(needed))
    return float(max(LEAST_FACTOR, needed[rank - 1] * (1.0 + 1e-9)))


def summarized(contacts: Sequence[SiteContact], factor: float = 1.0) -> ContactSites:
    """Return key figures of contacts, with the law's part of the estimated error times a factor."""
    if not contacts:
        return ContactSites()
    error = np.array([contact.error for contact in contacts])
    said = np.array([(c.estimate + (factor - 1.0) * c.law_estimate) / c.truth for c in contacts])
    return ContactSites(
        n_contacts=len(contacts),
        n_places=len({contact.site for contact in contacts}),
        mean=float(error.mean()),
        p95=float(np.quantile(error, 0.95)),
        worst=float(error.max()),
        coverage=float(np.mean(error <= said)),
        overestimate=float(np.median(said / np.maximum(error, 1e-6))),
        factor=factor,
    )


def draw_sites(vademecum: Vademecum, surface: SurfaceMesh, n: int, seed: int) -> list[Site]:
    """Return places drawn evenly over the accessible surface; the last two a ridge and a hollow.

    Places at the border of the accessible surface, where the step's force fades on purpose, are
    left out. If most of the surface is border, there may be fewer than ``n``.

    Parameters
    ----------
    surface : SurfaceMesh
        Surface that the vademecum was built from.
    n : int
        Number of places, at least 3.
    """
    sites = _open_sites(vademecum, surface, max(DRAWN, 2 * n), seed)
    rest = sites[n - 2 :]
    if len(rest) < 2:
        return sites
    ridge = max(rest, key=lambda site: site.kappa)
    hollow = min(rest, key=lambda site: site.kappa)
    return [*sites[: n - 2], replace(ridge, kind="ridge"), replace(hollow, kind="hollow")]


def edge_sites(vademecum: Vademecum, surface: SurfaceMesh, n: int, seed: int) -> list[Site]:
    """Return at most ``n`` of the drawn places where the organ is thinner than ``THIN``.

    The thinnest places come first.
    """
    sites = _open_sites(vademecum, surface, _MANY_DRAWN, seed)
    thick = np.array([_thickness(surface, site) for site in sites])
    order = np.argsort(thick)[:n]
    return [replace(sites[k], kind="edge") for k in order if thick[k] < THIN]


def _open_sites(vademecum: Vademecum, surface: SurfaceMesh, n: int, seed: int) -> list[Site]:
    """Return those of ``n`` evenly drawn places that a tip may press to the largest depth."""
    drawn = draw_contacts(vademecum, n, seed)
    sites = nearest_sites(vademecum, surface, drawn.place)
    return [site for site in sites if _access(vademecum, site) > OPEN]


def _thickness(surface: SurfaceMesh, site: Site) -> float:
    """Return the organ's thickness along a site's normal [m]."""
    faces = surface.faces.astype(np.int64)
    start = site.point - _SKIN * site.normal
    hits = igl.ray_mesh_intersect(start, -site.normal, surface.vertices, faces)
    return _SKIN + min((distance for _, distance, *_ in hits), default=np.inf)


def nearest_sites(vademecum: Vademecum, surface: SurfaceMesh, near: np.ndarray) -> list[Site]:
    """Return the places of the surface nearest to some points, shape (n, 3) [m]."""
    faces = surface.faces.astype(np.int64)
    points = igl.point_mesh_squared_distance(near, surface.vertices, faces)[2].reshape(-1, 3)
    return [_site(vademecum, point) for point in points]


def _site(vademecum: Vademecum, point: np.ndarray) -> Site:
    field = vademecum.tip_field

    def normal_at(at: np.ndarray) -> np.ndarray:
        slope = np.zeros(3)
        evaluate(field.distance, field.origin, field.spacing[0], at, slope, np.nan)
        return slope / max(float(np.linalg.norm(slope)), 1e-12)

    normal = normal_at(point)
    across = np.stack([ASIDE * side[0] for side in tangents(normal[None])])
    turns = [(normal_at(point + t) - normal_at(point - t)) @ t / ASIDE**2 for t in across]
    return Site("drawn", point, normal, float(0.25 * sum(turns)))


def _access(vademecum: Vademecum, site: Site) -> float:
    """Return the access at the largest depth below a site."""
    field, below = vademecum.tip_field, site.point - max(DEPTHS) * site.normal
    return float(evaluate(field.access, field.origin, field.spacing[0], below, np.zeros(3), 0.0))


class _Models(NamedTuple):
    """The step of one tip, the step of a patch in its place, and the tip."""

    real: ContactData
    patch: ContactData
    tip: Tip

    @classmethod
    def of(cls, vademecum: Vademecum, tip: Tip) -> _Models:
        real = model_of(vademecum, (tip,), cloud="volume", effects=())
        patch = model_of(vademecum, (Tip("patch", tip.radius),), cloud="off", effects=())
        return cls(real.data(), patch.data(), tip)


def compared(
    vademecum: Vademecum,
    surface: SurfaceMesh,
    site: Site,
    models: Sequence[_Models],
    depths: Sequence[float] = DEPTHS,
) -> list[SiteContact]:
    """Return the contacts of several tips at one site.

    A tip whose sides touch a hollow before it reaches the place is left out there.

    vademecum : linear, at its own material
    models : steps of each tip
    depths : depths of the lowest points below the surface [m]

    Raises
    ------
    MeshError, ContactError, ConvergenceError
        See :func:`avatar_core.offline.resolved_contact.contacts_at`.
    """
    organ = (surface, vademecum.mesh, vademecum.regions, vademecum.material)
    tips = [model.tip for model in models]
    truth = contacts_at(*organ, site.point, site.normal, tips, depths)
    vertices, mass = vademecum.mesh.vertices, vademecum.mesh.lumped_mass
    far = np.linalg.norm(vertices - site.point, axis=1) > FAR
    kept = np.repeat(far, 3)
    out = []
    fits = truth.condensed.first_depths > -FITS
    for i, (real, patch, tip) in enumerate(models):
        if not fits[i]:
            continue
        moved = truth.condensed.displacements(truth.contacts[i])[:, : len(vertices)]
        for k, depth in enumerate(depths):
            force, axis = pressed(real, site, tip, depth), truth.axes[i, k]
            shown = real.out.cloud[:, 3:].astype(float).ravel()
            out.append(
                SiteContact(
                    site,
                    tip,
                    depth,
                    float(truth.forces[i, k]),
                    float(force @ axis),
                    _angle(force, axis),
                    float(real.out.force_error[0]),
                    float(
                        law_error(real.model.arrays, real.state, 0)
                        * np.linalg.norm(real.out.force[0])
                    ),
                    float(pressed(patch, site, tip, depth) @ axis),
                    float(hertz_force(vademecum.material, tip.radius, depth))
                    if tip.shape == "sphere"
                    else np.nan,
                    float(relative_l2(shown[kept], moved[k].ravel()[kept], mass[kept])),
                )
            )
    return out


def hertz_force(material: Material, radius: float, depth: np.ndarray | float) -> np.ndarray:
    """Return 4/3 E* sqrt(R d^3) on a sphere in a half-space, at depths of any shape [N]."""
    stiffness = material.plane_strain_modulus
    return np.asarray(4.0 / 3.0 * stiffness * np.sqrt(radius * np.asarray(depth) ** 3))


def _angle(force: np.ndarray, axis: np.ndarray) -> float:
    """Return the angle between a force and a unit vector [rad]; NaN without a force."""
    size = np.linalg.norm(force)
    return float(np.arccos(np.clip(force @ axis / size, -1.0, 1.0))) if size > 0.0 else np.nan


def pressed(data: ContactData, site: Site, tip: Tip, depth: float) -> np.ndarray:
    """Return the step's force at a depth below a site, after an approach along its normal [N].

    The force has the shape (3,).
    """
    data.reset()
    for at in (*np.arange(-0.5e-3, depth, 1e-3), depth):
        status = step(data.model, data, (site.point + (tip.offset - at) * site.normal)[None])
    if status not in (Status.OK, Status.EXTRAPOLATED):
        return np.full(3, np.nan)
    estimate_error(data.model, data)
    return data.out.force[0].copy()
