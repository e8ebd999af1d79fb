"""From a surface to a certified vademecum in one call: what ``avatar vademecum`` does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import scipy.sparse as sp

from avatar_core.certify.combinations import COMBINATIONS, DEPTH_FRACTIONS, push_errors
from avatar_core.certify.contact_sites import with_contact_sites
from avatar_core.certify.large_deformation import certify_large, with_combinations
from avatar_core.certify.linear import certify, mesh_error
from avatar_core.certify.parametric import certify_range
from avatar_core.common.processes import cpu_seconds, repeatable
from avatar_core.contact.timing import timed
from avatar_core.errors import AvatarError, ContactError, CoordinateError, MaterialError, MeshError
from avatar_core.fem.elasticity import POISSON_RATIO_P2, Elasticity, Element, Inclusion, Material
from avatar_core.fem.patch_loads import LoadSurface, load_surface, patch_loads
from avatar_core.fem.resection import Resection, require_parts_held
from avatar_core.fem.supports import Support
from avatar_core.geometry.cut_surface import CutSurface
from avatar_core.geometry.cutting import cut, snapped
from avatar_core.geometry.doubts import doubts_of
from avatar_core.geometry.groups import regions_from_groups
from avatar_core.geometry.level_set import orientation_offset
from avatar_core.geometry.mesh import Regions, TetMesh, regions_by_rule, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.resampling import require_displayable
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tumour import volume_fraction_inside
from avatar_core.offline.large_deformation import (
    LargeRule,
    hyperelastic_problem,
    with_large_deformation,
)
from avatar_core.offline.linear import build_vademecum
from avatar_core.offline.parametric import build_parametric_vademecum
from avatar_core.offline.rule import NO_ERROR, BuildRule, Progress, silent
from avatar_core.offline.supports import SupportOption, held_by
from avatar_core.reduction.coordinates import LIMITS, RESECTION, Coordinate
from avatar_core.vademecum.display import DISPLAYED, organ_display
from avatar_core.vademecum.large_deformation import LargeMaterial
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.record import Provenance
from avatar_core.vademecum.tip_field import make_tip_field, with_tumour

COMBINED_SITES = 2  # at which large pushes are certified together with other effects
_RECORDED = ("avatar", "numpy", "scipy", "scikit-fem", "libigl", "pytetwild", "rslab", "h5py")


@dataclass(frozen=True)
class OrganOptions:
    """How an organ becomes a vademecum; the defaults are the paper's liver.

    Parameters
    ----------
    n_vertices : int
        Number of vertices of the mesh, about.
    material : Material
        Linear elastic material of the organ.
    element : Element or None
        Finite element. None takes the one that does not lock at the material's Poisson's ratio.
    patch_radius : float or None
        Radius of the loads [m]. None takes max(12 mm, 1.2 x surface edge).
    groups : Path or None
        File of node groups for clamp, accessible region and supports. None takes the rules.
    supports : tuple of SupportOption
        Springs that hold the organ instead of the clamp.
    resection : CutSurface or None
        Surface along which the organ is cut. How far it is opened is a coordinate.
    rule : BuildRule
        Tolerance and numbers of modes.
    coordinates : tuple of Coordinate
        Parameters of the material that stay free in the vademecum.
    tumour : SurfaceMesh or None
        Surface inside the organ, with another stiffness.
    contrast : float
        Young's modulus inside the tumour over that outside.
    large : LargeMaterial or None
        Material of large strains; the load's magnitude then is a coordinate up to the depth
        ``large_rule.max_push``. None for small strains.
    large_rule : LargeRule
        Depth and tolerances of large deformation.
    n_pushed : int
        Number of unseen sites at which large deformation is certified, by four nonlinear solutions
        each. The first ``COMBINED_SITES`` are certified together with other effects too, by nine
        more each.
    n_certified : int
        Number of unseen load positions of the certificate, at least 1.
    n_contact_sites : int
        Number of places, 0 or at least 3, at which the certificate resolves contacts of real tips.
    seed : int
        Seed of the places of the certificate.
    with_mesh_error : bool
        Solve on the same mesh refined once, too (slow).
    n_displayed : int
        Number of vertices of the displayed surface, about. 0 takes that of the mesh.

    Raises
    ------
    AvatarError
        For options that exclude each other or lie out of range, and for a file that does not exist,
        before any work.

    Examples
    --------
    >>> options = av.OrganOptions(
    ...     n_vertices=400, coordinates=(av.Coordinate("poisson", 0.40, 0.48),)
    ... )
    >>> [c.name for c in options.all_coordinates]
    ['poisson']
    """

    n_vertices: int = 2850
    material: Material = field(default_factory=Material)
    element: Element | None = None
    patch_radius: float | None = None
    groups: Path | None = None
    supports: tuple[SupportOption, ...] = ()
    resection: CutSurface | None = None
    rule: BuildRule = field(default_factory=BuildRule)
    coordinates: tuple[Coordinate, ...] = ()
    tumour: SurfaceMesh | None = None
    contrast: float = 1.0
    large: LargeMaterial | None = None
    large_rule: LargeRule = field(default_factory=LargeRule)
    n_pushed: int = 12
    n_certified: int = 200
    n_contact_sites: int = 0
    seed: int = 0
    with_mesh_error: bool = False
    n_displayed: int = DISPLAYED

    def __post_init__(self) -> None:
        names = [c.name for c in self.all_coordinates]
        if len(set(names)) < len(names):
            raise CoordinateError(f"a coordinate is given twice: {', '.join(names)}")
        if any(c.kind == "support" for c in self.coordinates):
            raise CoordinateError("a support's stiffness is chosen with --support NAME=LOW:HIGH")
        if any(c.kind == RESECTION for c in self.coordinates):
            raise CoordinateError("a resection needs its surface; give it with --resection FILE")
        if self.resection and (self.large or self.n_contact_sites or self.with_mesh_error):
            raise CoordinateError(
                "a resection is for small strains on one mesh; leave out large deformation, "
                "contact sites and the mesh error, or the resection"
            )
        held = [s.name for s in self.supports]
        if len(set(held)) < len(held):
            raise CoordinateError(f"a support is given twice: {', '.join(held)}")
        if ("contrast" in names or self.contrast != 1.0) and self.tumour is None:
            raise CoordinateError(
                "the contrast is that of a tumour; give its surface with --tumour"
            )
        for c, value, default in self._outside:
            if value != default:
                raise CoordinateError(
                    f"{c.name} is {value:g}, outside its range {c.low:g} to {c.high:g}; choose "
                    "one inside, or a wider --coordinate"
                )
        if self.seed < 0:
            raise AvatarError(f"the seed is {self.seed}; give 0 or more")
        if self.n_certified < 1:
            raise AvatarError(f"{self.n_certified} loads certify nothing; give 1 or more")
        low, high = LIMITS["contrast"]
        if not low <= self.contrast <= high:
            raise CoordinateError(f"the contrast is {self.contrast:g}; give {low:g} to {high:g}")
        if self.large and (self.all_coordinates or self.tumour or self.supports):
            raise CoordinateError(
                "large deformation is not combined with a tumour, supports or coordinates of the "
                "material; build two vademecums"
            )
        if self.n_contact_sites and (
            self.large or self.all_coordinates or self.tumour or self.supports
        ):
            raise CoordinateError(
                "contact sites are resolved on one linear material; leave them out, or tumour, "
                "supports, coordinates and large deformation"
            )
        if self.n_contact_sites != 0 and self.n_contact_sites < 3:
            raise ContactError(
                f"{self.n_contact_sites} contact sites; ask for at least 3, of which one is a "
                "ridge and one a hollow, or 0 for none"
            )
        if self.large and (self.element or self.material.element) != "P2":
            raise MaterialError(
                f"large deformation is solved on the element P2 up to Poisson's ratio "
                f"{POISSON_RATIO_P2}; take at most that, and no other --element"
            )
        if self.patch_radius is not None and not 1e-3 <= self.patch_radius <= 0.1:
            raise MeshError(
                f"a patch of radius {self.patch_radius:g} m is no tool's; give 1e-3 to 0.1 "
                "(12e-3: 12 mm)"
            )
        if self.n_displayed != 0:
            require_displayable(self.n_displayed)
        if self.groups is not None and not self.groups.is_file():
            raise MeshError(f"cannot read node groups from {self.groups}: there is no such file")

    @property
    def all_coordinates(self) -> tuple[Coordinate, ...]:
        """Those of the material, of the supports and of the resection."""
        supports = (s.coordinate for s in self.supports if s.coordinate)
        cut = (Coordinate(RESECTION, 0.0, 1.0),) if self.resection else ()
        return (*self.coordinates, *supports, *cut)

    @property
    def _outside(self) -> list[tuple[Coordinate, float, float]]:
        """Coordinates whose range leaves out the organ's value, with the value and its default."""
        own = {
            "poisson": (self.material.poisson_ratio, Material.poisson_ratio),
            "contrast": (self.contrast, OrganOptions.contrast),
        }
        found = [(c, *own[c.name]) for c in self.coordinates]
        return [one for one in found if not one[0].low <= one[1] <= one[0].high]

    @property
    def notices(self) -> tuple[str, ...]:
        """Defaults that are moved into the ranges of the coordinates, one line each."""
        return tuple(
            f"{c.name} is {min(max(value, c.low), c.high):g} until one is chosen: its default "
            f"{value:g} lies outside {c.low:g} to {c.high:g}"
            for c, value, _ in self._outside
        )


@repeatable
def build(
    surface: SurfaceMesh,
    options: OrganOptions | None = None,
    progress: Progress = silent,
    responded: Callable[[Vademecum], None] | None = None,
) -> Vademecum:
    """Mesh, solve, separate and certify one organ, and time its steps on this machine.

    The same surface and options give the same vademecum, bit for bit, but for what a clock says.

    Parameters
    ----------
    responded : callable, optional
        Called with the vademecum once it has its response, before it is certified: certifying
        compiles the step, for about a minute on a new machine.

    Raises
    ------
    AvatarError
        Of the stage that refused, with the remedy.

    Examples
    --------
    >>> options = av.OrganOptions(
    ...     n_vertices=300, n_displayed=0, n_certified=4, rule=av.BuildRule(max_modes=20)
    ... )
    >>> small = av.build(liver, options)  # seconds; the default takes a minute
    >>> small.n_modes <= 20
    True
    """
    options = options or OrganOptions()
    provenance = _provenance(surface, options)
    progress("mesh", 0.0, NO_ERROR)
    problem = organ_problem(surface, options)
    elasticity, regions, loads = problem.elasticity, problem.regions, problem.surface
    mesh = elasticity.mesh
    progress("mesh", 1.0, NO_ERROR)
    common = (surface.name, elasticity, regions, loads)
    inside = () if options.tumour is None else (options.tumour,)
    display = organ_display(mesh, surface, options.n_displayed, inside)
    tip_field = make_tip_field(mesh, regions, loads.patch_radius, surface)
    last = (options.rule, provenance, progress, display)

    def count(done: int) -> None:
        progress("certify", done / options.n_certified, NO_ERROR)

    if options.all_coordinates:
        vademecum = build_parametric_vademecum(*common, options.all_coordinates, tip_field, *last)
    else:
        vademecum = build_vademecum(*common, tip_field, *last)
    if responded is not None:
        responded(vademecum)
    if options.all_coordinates:
        certificate = certify_range(vademecum, elasticity, options.n_certified, options.seed, count)
    else:
        certificate = certify(vademecum, elasticity, options.n_certified, options.seed, count)
    if options.tumour is not None:
        field = with_tumour(vademecum.tip_field, options.tumour, loads.patch_radius)
        vademecum = replace(vademecum, tip_field=field)
    if options.large:
        vademecum = _with_large(vademecum, options, progress)
    if options.with_mesh_error:
        progress("mesh error", 0.0, NO_ERROR)
        l2, contact = mesh_error(vademecum, elasticity)
        certificate = replace(certificate, mesh_l2=l2, mesh_contact=contact)
    progress("certify", 1.0, certificate.l2_mean)
    vademecum = vademecum.with_certificate(certificate)
    if options.n_contact_sites:
        vademecum = with_contact_sites(
            vademecum, surface, options.n_contact_sites, options.seed, progress
        )
    certificate = vademecum.certificate or certificate
    certificate = replace(certificate, build_cpu_seconds=cpu_seconds())
    return _timed(vademecum.with_certificate(certificate), progress)


def _timed(vademecum: Vademecum, progress: Progress) -> Vademecum:
    """Return the vademecum with the times of its curve, or a notice why they were not measured."""
    certificate = vademecum.certificate
    assert certificate is not None and certificate.curve is not None
    try:
        curve = timed(vademecum, certificate.curve, lambda done: progress("time", done, NO_ERROR))
    except AvatarError as error:
        return vademecum.with_notices(f"steps were not timed: {error}")
    return vademecum.with_certificate(replace(certificate, curve=curve))


def _with_large(vademecum: Vademecum, options: OrganOptions, progress: Progress) -> Vademecum:
    """Return the vademecum with the load's magnitude as a coordinate, certified."""
    assert options.large is not None
    problem = hyperelastic_problem(vademecum, options.large)
    vademecum = with_large_deformation(
        vademecum, problem, options.large, options.large_rule, progress
    )
    if options.n_pushed == 0:
        return vademecum
    n_combined = min(COMBINED_SITES, options.n_pushed)
    # a combination takes about as long as two sites: it loses equilibrium sooner
    alone = options.n_pushed / (options.n_pushed + 2 * n_combined * len(COMBINATIONS))
    certificate, _ = certify_large(
        vademecum,
        problem,
        options.n_pushed,
        options.large_rule.max_push,
        options.seed,
        lambda fraction, error: progress("push", alone * fraction, error),
    )
    rows = push_errors(
        vademecum,
        problem,
        [fraction * options.large_rule.max_push for fraction in DEPTH_FRACTIONS],
        n_combined,
        options.seed,
        progress=lambda fraction: progress(
            "push", alone + (1.0 - alone) * fraction, certificate.l2_mean
        ),
    )
    return vademecum.with_large_certificate(with_combinations(certificate, rows))


@dataclass(frozen=True, eq=False)
class OrganProblem:
    """The finite-element problem of an organ, K u(s) = f(s) for all loads s, before any solution.

    Attributes
    ----------
    elasticity : Elasticity
        K: it solves and applies.
    regions : Regions
        Clamped and accessible faces over ``elasticity.mesh.boundary_faces``.
    surface : LoadSurface
        Load positions, normals and patch radius.

    Examples
    --------
    >>> problem = av.organ_problem(liver, av.OrganOptions(n_vertices=300))
    >>> problem.loads.shape[1] == 3 * problem.surface.n_positions
    True
    """

    elasticity: Elasticity
    regions: Regions
    surface: LoadSurface

    @cached_property
    def loads(self) -> sp.csc_matrix:
        """F: unit loads in x, y and z on each patch, (3 n_nodes, 3 n_positions) [N]."""
        at = self.surface
        return patch_loads(self.elasticity, at.centers, at.patch_radius).tocsc()


@repeatable
def organ_problem(surface: SurfaceMesh, options: OrganOptions | None = None) -> OrganProblem:
    """Mesh an organ, hold it and discretize it, as :func:`build` does before it solves.

    Parameters
    ----------
    options : OrganOptions, optional
        Mesh, material, element, supports and patch radius count here.

    Returns
    -------
    OrganProblem

    Raises
    ------
    AvatarError
        If the surface cannot be meshed or held; the message names the remedy.

    Examples
    --------
    >>> problem = av.organ_problem(liver, av.OrganOptions(n_vertices=300))
    >>> u = problem.elasticity.solve(problem.loads[:, :3])
    >>> u.shape[1]
    3
    """
    options = options or OrganOptions()
    elasticity, regions = _problem(surface, options)
    loads = load_surface(elasticity.mesh, regions, options.patch_radius)
    return OrganProblem(elasticity, regions, loads)


def _problem(surface: SurfaceMesh, options: OrganOptions) -> tuple[Elasticity, Regions]:
    """Return the elastic problem of an organ, and its regions.

    Raises MaterialError if the opened resection leaves a part loose.
    """
    mesh = tetrahedralize(surface, options.n_vertices)
    if options.resection is None:
        regions, supports = _held(mesh, options)
        return _elasticity(mesh, regions, supports, options), regions
    whole, second = snapped(mesh, options.resection)
    regions, supports = _held(whole, options)  # a cut leaves the boundary's faces as they were
    mesh = cut(whole, second)
    young = options.material.young_modulus
    resection = Resection.of(mesh, options.resection, young)
    opened = replace(resection, opened=1.0)
    require_parts_held(mesh, opened, regions.clamped, supports, young)
    return _elasticity(mesh, regions, supports, options, resection), regions


def _held(mesh: TetMesh, options: OrganOptions) -> tuple[Regions, tuple[Support, ...]]:
    """Return the clamp, accessible region and supports."""
    if options.supports:
        return held_by(mesh, options.supports, options.groups)
    if options.groups:
        return regions_from_groups(mesh, options.groups), ()
    return regions_by_rule(mesh), ()


def _elasticity(
    mesh: TetMesh,
    regions: Regions,
    supports: tuple[Support, ...],
    options: OrganOptions,
    resection: Resection | None = None,
) -> Elasticity:
    """Return the elastic problem, on one element that serves the whole range of Poisson's ratio."""
    ratios = [c.high for c in options.coordinates if c.name == "poisson"]
    stiffest = replace(options.material, poisson_ratio=max(ratios)) if ratios else options.material
    inclusion = None
    if options.tumour is not None:
        inclusion = Inclusion(volume_fraction_inside(mesh, options.tumour), options.contrast)
    element = options.element or stiffest.element
    problem = Elasticity(
        mesh, options.material, regions.clamped, element, inclusion, supports, resection
    )
    # One factor then serves build and certificate; a range of values has one for each.
    return problem if options.coordinates or resection else problem.refining()


@lru_cache(maxsize=1)  # a command prints them before it builds
def notices_of(surface: SurfaceMesh, options: OrganOptions) -> tuple[str, ...]:
    """Return the notices before a build, one line each: what was read, and what is doubtful.

    Raises SurfaceError if less than half of the tumour lies in the organ.
    """
    tumours = () if options.tumour is None else (options.tumour,)
    read = [notice for one in (surface, *tumours) for notice in one.notices]
    turned = orientation_offset(surface, phantom_liver()).warning
    doubts = doubts_of(surface, tumours, options.groups is not None)
    return (*dict.fromkeys(read), *((turned,) if turned else ()), *doubts, *options.notices)


def _provenance(surface: SurfaceMesh, options: OrganOptions) -> Provenance:
    parameters = {**vars(options), **asdict(options.rule), **asdict(options.material)}
    parameters |= asdict(options.large_rule) if options.large else {}
    for name in ("rule", "material", "large_rule"):
        del parameters[name]
    parameters["coordinates"] = " ".join(map(str, options.coordinates)) or None
    parameters["supports"] = " ".join(map(str, options.supports)) or None
    parameters["tumour"] = options.tumour and options.tumour.name
    parameters["resection"] = options.resection and str(options.resection)
    return Provenance(
        source=surface.name,
        source_sha256=surface.source_sha256,
        unit=surface.unit,
        axes=surface.axes_name,
        versions=tuple(f"{name} {_version(name)}" for name in _RECORDED),
        parameters=tuple(f"{name}={value}" for name, value in sorted(parameters.items())),
        notices=notices_of(surface, options),
    )


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"
