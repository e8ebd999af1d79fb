"""From a surface to a certified vademecum in one call: what ``avatar vademecum`` does."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from avatar_core.build import BuildRule, Progress, _silent, build_vademecum
from avatar_core.certificate import certify, mesh_error
from avatar_core.elasticity import Elasticity, Element, Material
from avatar_core.level_set import orientation_offset
from avatar_core.loads import load_surface
from avatar_core.mesh import regions_by_rule, regions_from_groups, tetrahedralize
from avatar_core.phantom import phantom_liver
from avatar_core.surface import SurfaceMesh
from avatar_core.vademecum import Provenance, Vademecum

_RECORDED = ("avatar", "numpy", "scipy", "scikit-fem", "libigl", "pytetwild", "rslab", "h5py")


@dataclass(frozen=True)
class OrganOptions:
    """How an organ becomes a vademecum; the defaults are the paper's liver.

    n_vertices : of the mesh, about
    material : Material
    element : None for the one that does not lock at the material's Poisson's ratio
    patch_radius : of the tool's traction [m]; None for max(12 mm, 1.2 x surface edge)
    groups : file of node groups for clamp and accessible region; None for the anatomical rule
    rule : BuildRule
    n_certified : unseen load positions of the certificate; ``seed`` draws them
    with_mesh_error : also solve on the same mesh refined once (slow)
    """

    n_vertices: int = 2850
    material: Material = field(default_factory=Material)
    element: Element | None = None
    patch_radius: float | None = None
    groups: Path | None = None
    rule: BuildRule = field(default_factory=BuildRule)
    n_certified: int = 200
    seed: int = 0
    with_mesh_error: bool = False


def vademecum_of(
    surface: SurfaceMesh, options: OrganOptions | None = None, progress: Progress = _silent
) -> Vademecum:
    """Mesh, solve, separate and certify one organ.

    Raises
    ------
    AvatarError
        Of the stage that refused, with the remedy.
    """
    options = options or OrganOptions()
    progress("mesh", 0.0)
    mesh = tetrahedralize(surface, options.n_vertices)
    progress("mesh", 1.0)
    regions = regions_from_groups(mesh, options.groups) if options.groups else regions_by_rule(mesh)
    elasticity = Elasticity(mesh, options.material, regions.clamped, options.element)
    loads = load_surface(mesh, regions, options.patch_radius)
    vademecum = build_vademecum(
        surface.name,
        elasticity,
        regions,
        loads,
        options.rule,
        _provenance(surface, options),
        progress,
    )
    certificate = certify(
        vademecum,
        elasticity,
        options.n_certified,
        options.seed,
        lambda done: progress("certify", done / options.n_certified),
    )
    if options.with_mesh_error:
        progress("mesh error", 0.0)
        l2, contact = mesh_error(vademecum, elasticity)
        certificate = replace(certificate, mesh_l2=l2, mesh_contact=contact)
    progress("certify", 1.0)
    return vademecum.with_certificate(replace(certificate, build_cpu_seconds=cpu_seconds()))


def orientation_warning(surface: SurfaceMesh) -> str | None:
    """A warning if the surface lies more than 45 degrees off the phantom, naming the option."""
    return orientation_offset(surface, phantom_liver()).warning


def cpu_seconds() -> float:
    """User + system time of this process and its children so far [s]."""
    return sum(os.times()[:4])


def _provenance(surface: SurfaceMesh, options: OrganOptions) -> Provenance:
    parameters = {**asdict(options), **asdict(options.rule), **asdict(options.material)}
    flat = {k: v for k, v in parameters.items() if not isinstance(v, dict)}
    return Provenance(
        source=surface.name,
        source_sha256=surface.source_sha256,
        unit=surface.unit,
        axes=surface.axes_name,
        versions=tuple(f"{name} {_version(name)}" for name in _RECORDED),
        parameters=tuple(f"{name}={value}" for name, value in sorted(flat.items())),
        notices=surface.notices,
    )


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
