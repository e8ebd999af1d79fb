"""The text of ``avatar show``."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from avatar_core.fem.supports import Support
    from avatar_core.vademecum.accuracy import AccuracyCurve, CurvePoint
    from avatar_core.vademecum.certificate import ContactSites
    from avatar_core.vademecum.model import Vademecum


def show_text(v: Vademecum) -> None:
    """Print the text of ``avatar show``."""
    info, c = v.info(), v.certificate
    print(f"{info.name}  (from {info.source}, {v.provenance.unit}, axes {info.axes})")
    print(
        f"  {info.n_vertices} vertices ({info.n_surface_vertices} on the surface), "
        f"{info.volume * 1e6:.0f} ml, {v.element}, E {info.young_modulus:g} Pa, "
        f"nu {info.poisson_ratio:g}"
    )
    if v.display is not None:
        inside = f"; inside: {', '.join(v.structures)}" if v.structures else ""
        print(f"  displayed: {len(set(v.organ_faces.flat))} vertices{inside}")
    print(
        f"  {info.n_load_positions} load positions, patch radius {info.patch_radius * 1e3:.1f} mm, "
        f"{info.n_modes} modes at a place, {info.n_regions} regions, {info.bytes / 1e6:.1f} MB"
    )
    if v.contrast is not None:
        print(f"  tumour: {v.contrast:g} times the organ's Young's modulus")
    for support in v.supports:
        print(
            f"  support {support.name}: {support.stiffness:.3g} N/m^3 on "
            f"{1e4 * supported_area(v, support):.0f} cm^2"
        )
    if v.supports and v.regions.clamped.any():
        print(f"  clamped: {1e4 * v.mesh.face_areas[v.regions.clamped].sum():.0f} cm^2")
    _show_resection(v)
    for one in v.parametric.coordinates if v.parametric else ():
        print(f"  coordinate {one.name}: {one.low:g} to {one.high:g} ({one.n_nodes} nodes)")
    if c is None:
        print("  no certificate")
        return
    print(
        "  the force acts on a rigid, frictionless tip of the given shape and size, pressed\n"
        "  along the normal of the surface that was read; the shaft has no contact. Its errors\n"
        "  are under 'contact sites'. Errors of a patch are those of the load that the vademecum\n"
        "  was computed for"
    )
    where, every = " and values" if v.parametric else "", v.convergence
    of_all = ("displacement, all load positions", every.every_mean, every.every_worst)
    print(f"  errors on {c.n_loads} unseen loads{where} x 3 directions    mean     worst")
    for name, mean, worst in (
        ("displacement, L2", c.l2_mean, c.l2_worst),
        ("contact compliance", c.contact_mean, c.contact_worst),
        ("force of a patch at a depth", c.force_mean, c.force_worst),
        ("the same, anywhere on the surface", c.tip_force_mean, c.tip_force_worst),
        *([] if math.isnan(every.every_mean) else [of_all]),
    ):
        print(f"    {name:38s} {mean:8.2%}  {worst:8.2%}")
    _show_contact_sites(c.contact_sites)
    _show_large(v)
    if c.curve is not None:
        _show_curve(c.curve)
    print(f"  built in {c.build_cpu_seconds:.0f} s of CPU time", end="")
    tolerance = every.tolerance
    state = "converged" if info.converged else "NOT CONVERGED"
    print(", interpolated" if math.isnan(tolerance) else f", {state} (tolerance {tolerance:.1%})")
    if not math.isnan(c.mesh_l2):
        print(f"  mesh refined once: displacement {c.mesh_l2:.1%}, contact {c.mesh_contact:.1%}")


def _show_contact_sites(found: ContactSites) -> None:
    """Print the errors of the force on real tips against resolved contact."""
    if found.n_contacts == 0:
        print("  contact sites: none; --contact-sites of 'avatar vademecum' resolves contacts")
        return
    print(
        f"  contact sites: {found.n_contacts} resolved contacts at {found.n_places} places; "
        f"the estimated error covers {found.coverage:.0%},\n    a median of "
        f"{found.overestimate:.1f} times the true one (the contact law's part times "
        f"{found.factor:.2f})"
    )
    shown = f"{found.mean:8.2%}  {found.worst:8.2%}"
    print(f"    {'force of a tip at a depth':38s} {shown}   (95 % below {found.p95:.2%})")


def _show_curve(curve: AccuracyCurve) -> None:
    """Print the error of displacement by number of modes, and the error of the force."""
    row = curve.of("surface").points
    where = f", timed on {curve.machine}" if curve.machine else ", not timed"
    print(f"  error that 95 % of touches keep, surface shown at every step{where}")
    for point in row[::2] if len(row) > 4 else row:
        _show_point(point)
    if row[-1] not in row[::2]:
        _show_point(row[-1])
    print(f"    {'force, with any number of modes':38s} {row[-1].force:8.2%}")


def _show_point(point: CurvePoint) -> None:
    spent = (
        "" if math.isnan(point.p50) else f"  {1e6 * point.p50:5.0f} us (p99 {1e6 * point.p99:.0f})"
    )
    print(f"    {f'{point.detail.modes} modes':38s} {point.l2:8.2%}{spent}")


def _show_large(v: Vademecum) -> None:
    if v.large is None:
        return
    reach, pulled = v.large.reach * 1e3
    print(
        f"  large deformation, {v.large.material}: {v.large.terms.rank} modes at a place, linear "
        f"depth up to {reach.max():.0f} mm (half of the positions "
        f"{sorted(reach)[len(reach) // 2]:.0f}, the least {reach.min():.0f}), pulled "
        f"{sorted(pulled)[len(pulled) // 2]:.0f} mm"
    )
    c = v.large.certificate
    if c is None:
        return
    print(f"  errors on {c.n_pushes} unseen pushes to {c.depth * 1e3:.0f} mm      mean     worst")
    for name, mean, worst in (
        ("displacement, L2", c.l2_mean, c.l2_worst),
        ("force at equal depth", c.contact_mean, c.contact_worst),
    ):
        print(f"    {name:38s} {mean:8.2%}  {worst:8.2%}")
    print(f"    the linear vademecum: {c.linear_l2_mean:.1%}, {c.linear_contact_mean:.1%}")
    if c.n_pulls:
        print(
            f"    {c.n_pulls} pulls: displacement {c.pull_l2_mean:.1%} (linear "
            f"{c.pull_linear_l2_mean:.1%}), force {c.pull_contact_mean:.1%}"
        )
    print("    the force, with another effect added linearly")
    for name, mean in (
        ("30 degrees off the normal", c.oblique_contact_mean),
        ("two tools 40 mm apart", c.two_tools_contact_mean),
        ("an organ under its weight", c.gravity_contact_mean),
    ):
        print(f"      {name:36s} {'not measured' if math.isnan(mean) else f'{mean:8.2%}'}")
    if c.n_lost:
        print(
            f"    at {c.n_lost} of {c.n_sites} sites full finite elements lost equilibrium before "
            "the stored range ends"
        )


def supported_area(v: Vademecum, support: Support) -> float:
    """Return the area of the surface that a support holds [m^2]."""
    return float(v.mesh.face_areas[support.faces].sum())


def _show_resection(v: Vademecum) -> None:
    """Print the volumes of both parts, and the margins of structures."""
    from avatar_core.vademecum.resected import margins, part_volumes

    if v.resection is None:
        return
    volumes = part_volumes(v)
    first, second = (f"{1e6 * one:.0f} ml ({one / sum(volumes):.0%})" for one in volumes)
    print(
        f"  resection: {first} on one side, {second} on the side of the normal; "
        f"opened to {v.resection.opened:g}"
    )
    for name, margin in margins(v).items():
        far = f"{1e3 * margin:.1f} mm from" if margin > 0.0 else "cut by"
        print(f"    {name}: {far} the resection at rest")
