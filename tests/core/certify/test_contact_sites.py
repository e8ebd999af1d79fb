"""Contact sites: resolved contacts in a certificate, and the error estimated from them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from avatar_core import pipeline
from avatar_core.certify import contact_sites
from avatar_core.certify.contact_sites import (
    LEAST_FACTOR,
    Site,
    SiteContact,
    law_factor,
    summarized,
    with_contact_sites,
)
from avatar_core.cli import picture
from avatar_core.contact import timing
from avatar_core.errors import ContactError, MeshError, StorageError
from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.fem.patch_loads import load_surface
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.geometry.tip import Tip
from avatar_core.offline.linear import build_vademecum
from avatar_core.offline.rule import BuildRule
from avatar_core.tips.law import SLOPE_ERROR, VARIATION_ERROR
from avatar_core.vademecum.certificate import Certificate, ContactSites
from avatar_core.vademecum.force_error import PROMISED, ForceError
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.record import Provenance
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from avatar_core.vademecum.tip_field import make_tip_field
from tests.core.cli.test_cli import write_obj
from tests.core.conftest import Command, box_mesh, box_regions
from tests.helpers.box_organ import UP, organ
from tests.helpers.contact import estimate_error, prepare, step

SITE = Site("drawn", np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0)
BALL = Tip("sphere", 3e-3)
FOUND = ContactSites(36, 3, 0.04, 0.1, 0.15, 0.92, 3.1, 1.4)
Compared = Callable[..., list[SiteContact]]


def contact(force: float, patch: float, law: float, site: Site = SITE) -> SiteContact:
    """Return a contact with a resolved force of 2 N; errors by the patch and by the law [N]."""
    return SiteContact(site, BALL, 1e-3, 2.0, force, 0.0, patch + law, law, 6.0, 1.0, 0.05)


@pytest.fixture(scope="module")
def box() -> Vademecum:
    """Build a small box with few modes, and a certificate."""
    mesh = box_mesh(4)
    regions = box_regions(mesh)
    elasticity = Elasticity(mesh, Material(), regions.clamped, "P1")
    loads = load_surface(mesh, regions)
    vademecum = build_vademecum(
        "box",
        elasticity,
        regions,
        loads,
        make_tip_field(mesh, regions, loads.patch_radius),
        BuildRule(tolerance=0.9, max_modes=10),
        Provenance("box", ""),
    )
    known = replace(Certificate.unknown(), force_error=ForceError(1.0, 0.02))
    return vademecum.with_certificate(known)


def outline(vademecum: Vademecum) -> SurfaceMesh:
    """Return the boundary of the organ's mesh."""
    return SurfaceMesh(
        vademecum.mesh.vertices[vademecum.mesh.surface_vertices], vademecum.surface_faces
    )


def certified(vademecum: Vademecum, found: ContactSites) -> Vademecum:
    return vademecum.with_certificate(
        replace(vademecum.certificate or Certificate.unknown(), contact_sites=found)
    )


# --- The estimated error -------------------------------------------------------------------------


def pressed(vademecum: Vademecum) -> tuple[float, float, float]:
    """Return the force on a sphere 2 mm deep, its estimated error, and the law's relative part."""
    tip = Tip("sphere", 5e-3)
    data = prepare(vademecum, (tip,), cloud="off", effects=())
    centre = np.array([0.05, 0.1, 0.05])
    for depth in (-1e-3, 2e-3):
        step(data, (centre + (tip.offset - depth) * UP)[None])
    estimate_error(data)
    force = float(np.linalg.norm(data.out.force[0]))
    s, depth = data.state, -data.state.gap[0]
    softer = np.linalg.norm(s.self_slope[0]) * depth / s.self_compliance[0]
    law = SLOPE_ERROR * abs(s.steepness[0] - 1.0) + VARIATION_ERROR * softer
    return (force, float(data.out.force_error[0]), float(law))


def test_the_factor_scales_the_laws_part_of_the_error_that_is_said(box: Vademecum) -> None:
    force, once, law = pressed(box)
    same, thrice, _ = pressed(certified(box, replace(FOUND, factor=3.0)))
    assert force == same > 0.0
    assert thrice - once == pytest.approx(2.0 * law * force, rel=1e-5)


def test_edges_are_the_thinnest_places_below_a_thickness(
    box: Vademecum, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A box of 0.1 m has none; with a larger threshold its edges count, at their own thickness."""
    surface = outline(box)
    assert contact_sites.edge_sites(box, surface, 3, seed=0) == []
    monkeypatch.setattr(contact_sites, "THIN", 0.2)
    found = contact_sites.edge_sites(box, surface, 3, seed=0)
    assert [site.kind for site in found] == ["edge"] * 3
    thick = [contact_sites._thickness(surface, site) for site in found]
    np.testing.assert_allclose(thick, 0.1, rtol=0.02)


def test_an_organ_without_contact_sites_says_the_same_error_as_with_the_factor_one(
    box: Vademecum,
) -> None:
    assert pressed(box) == pressed(certified(box, replace(FOUND, factor=1.0)))


@pytest.mark.parametrize("scale", [0.3, 5.0])
def test_the_factor_covers_nine_in_ten_contacts_and_hardly_more(scale: float) -> None:
    """The earlier estimate was too small, or too large."""
    rng = np.random.default_rng(1)
    contacts = [contact(2.0 + scale * e, 0.02, 0.1) for e in rng.normal(0.0, 0.1, 300)]
    found = summarized(contacts, law_factor(contacts))
    assert PROMISED <= found.coverage <= PROMISED + 0.02 or found.factor == LEAST_FACTOR
    assert (found.factor > 1.0) == (scale > 1.0)


def test_a_few_contacts_that_are_met_by_luck_leave_half_of_the_laws_error() -> None:
    assert law_factor([contact(2.0, 0.1, 0.1)] * 5) == LEAST_FACTOR


def test_key_figures_are_those_of_the_contacts() -> None:
    other = replace(SITE, kind="ridge")
    contacts = [contact(2.2, 0.1, 0.05), contact(2.1, 0.1, 0.05), contact(2.0, 0.0, 0.1, other)]
    found = summarized(contacts)
    assert (found.n_contacts, found.n_places, found.factor) == (3, 2, 1.0)
    assert found.mean == pytest.approx(0.05)
    assert found.worst == pytest.approx(0.1)
    assert found.p95 == pytest.approx(0.095)
    assert found.coverage == pytest.approx(2 / 3)  # 2.2 N is 0.2 N off, with an estimate of 0.15 N
    assert found.overestimate == pytest.approx(1.5)
    assert summarized(contacts, 2.1).coverage == 1.0


# --- Places that cannot be resolved --------------------------------------------------------------


def met(fails: Sequence[str] = ()) -> Compared:
    """Return results in place of resolved contacts: 4 % off, or no mesh at places of some kinds."""

    def compared(*arguments: Any) -> list[SiteContact]:
        site = arguments[2]
        if site.kind in fails:
            raise MeshError("too large")
        return [contact(2.08, 0.02, 0.04, site) for _ in range(12)]

    return compared


def test_places_that_cannot_be_resolved_are_counted_in_a_notice(
    box: Vademecum, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contact_sites, "compared", met(fails=["ridge", "hollow"]))
    seen: list[tuple[str, float]] = []
    found = with_contact_sites(box, outline(box), 5, 0, lambda *said: seen.append(said[:2]))
    assert found.certificate is not None
    sites = found.certificate.contact_sites
    assert (sites.n_places, sites.n_contacts) == (3, 36)
    assert sites.mean == pytest.approx(0.04)
    assert sites.coverage == 1.0
    (notice,) = found.provenance.notices
    assert "2 that could not be resolved" in notice and "too large" in notice
    assert [stage for stage, _ in seen] == ["contacts"] * 6
    assert [fraction for _, fraction in seen] == pytest.approx(np.linspace(0.0, 1.0, 6))


def test_an_organ_none_of_whose_places_can_be_resolved_has_no_figures(
    box: Vademecum, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contact_sites, "compared", met(fails=["drawn", "ridge", "hollow"]))
    found = with_contact_sites(box, outline(box), 3, 0)
    assert found.certificate is not None
    assert repr(found.certificate.contact_sites) == repr(ContactSites())  # NaN differs from NaN
    assert "3 that could not be resolved" in found.provenance.notices[0]


def test_poses_that_the_step_refuses_are_counted_in_a_notice(
    box: Vademecum, monkeypatch: pytest.MonkeyPatch
) -> None:
    def compared(*arguments: Any) -> list[SiteContact]:
        return [contact(force, 0.1, 0.1, arguments[2]) for force in (2.0, float("nan"))]

    monkeypatch.setattr(contact_sites, "compared", compared)
    found = with_contact_sites(box, outline(box), 3, 0)
    assert found.certificate is not None
    assert found.certificate.contact_sites.n_contacts == 3
    assert "3 poses" in found.provenance.notices[0]


# --- Files ---------------------------------------------------------------------------------------


def test_a_file_gives_back_the_contact_sites(box: Vademecum, tmp_path: Path) -> None:
    save_vademecum(certified(box, FOUND), tmp_path / "a.h5")
    again = load_vademecum(tmp_path / "a.h5")
    assert again.certificate is not None
    assert again.certificate.contact_sites == FOUND
    assert pressed(again) == pressed(certified(box, FOUND))


@pytest.mark.parametrize("factor", [-1.0, 0.0, float("nan"), float("inf")])
def test_a_factor_that_is_none_is_refused(factor: float) -> None:
    with pytest.raises(StorageError, match="build the file again"):
        ContactSites(factor=factor)


# --- The command ---------------------------------------------------------------------------------


def test_the_command_resolves_contacts_and_says_what_it_left_out(
    box: Vademecum, avatar: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(contact_sites, "compared", met(fails=["ridge"]))
    monkeypatch.setattr(pipeline, "tetrahedralize", lambda *_: box.mesh)
    monkeypatch.setattr(pipeline, "timed", lambda _, curve, __: curve)
    write_obj(tmp_path / "box.obj", outline(box).vertices, outline(box).faces)
    source, file = [tmp_path / "box.obj", "--unit", "m"], tmp_path / "v.h5"
    small = ["--modes", "10", "--certify", "5", "--element", "P1", "--tolerance", "0.9"]
    asked = ["--contact-sites", "4"]
    code, out, err = avatar("vademecum", *source, "-o", file, *small, *asked)
    assert code == 0
    assert "notice: contact sites: left out 1 that could not be resolved" in err
    assert "36 resolved contacts at 3 places" in out
    stored = json.loads(avatar("show", file, "--json")[1])["certificate"]["contact_sites"]
    assert stored["n_contacts"] == 36
    assert stored["mean"] == pytest.approx(0.04)


def test_a_certified_build_is_written_whatever_times_it(
    box: Vademecum, avatar: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def refuses(*_: Any) -> None:
        raise ContactError("no path to slide along")

    monkeypatch.setattr(pipeline, "tetrahedralize", lambda *_: box.mesh)
    monkeypatch.setattr(timing, "slide", refuses)
    write_obj(tmp_path / "box.obj", outline(box).vertices, outline(box).faces)
    source, file = [tmp_path / "box.obj", "--unit", "m"], tmp_path / "v.h5"
    small = ["--modes", "10", "--certify", "5", "--element", "P1", "--tolerance", "0.9"]
    code, out, err = avatar("vademecum", *source, "-o", file, *small)
    assert code == 0
    assert "notice: steps were not timed: no path to slide along\n" in err
    assert ", not timed" in out
    built = load_vademecum(file).certificate
    assert built is not None and built.n_loads == 5


def test_show_prints_contact_sites_and_what_the_force_is_of(
    box: Vademecum, avatar: Command, tmp_path: Path
) -> None:
    save_vademecum(certified(box, FOUND), tmp_path / "a.h5")
    save_vademecum(box, tmp_path / "b.h5")
    shown = " ".join(avatar("show", tmp_path / "a.h5")[1].split())
    assert "36 resolved contacts at 3 places" in shown and "covers 92%" in shown
    assert "4.00% 15.00% (95 % below 10.00%)" in shown
    assert "rigid, frictionless tip" in shown
    assert "contact sites: none" in avatar("show", tmp_path / "b.h5")[1]


# --- The picture ---------------------------------------------------------------------------------


def test_the_picture_compares_the_step_hertz_and_resolved_contact(
    box: Vademecum, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = np.arange(1.0, 6.0)
    monkeypatch.setattr(
        picture, "contacts_at", lambda *_, **__: SimpleNamespace(forces=truth[None])
    )
    place = np.array([[0.05, 0.1, 0.05]])
    (site,) = contact_sites.nearest_sites(box, outline(box), place)
    curve = picture.force_curve(box, outline(box), site, prepare(box, (picture.TIP,)))
    stiffness = box.material.young_modulus / (1.0 - box.material.poisson_ratio**2)
    assert curve.depth[-1] == 5e-3
    assert curve.hertz[-1] == pytest.approx(4 / 3 * stiffness * np.sqrt(5e-3 * 5e-3**3))
    assert curve.force[0] == pytest.approx(0.0, abs=1e-6)
    assert (np.diff(curve.force) > 0.0).all() and (curve.error[1:] > 0.0).all()
    assert (curve.force[1:] < curve.hertz[1:]).all()  # the box is more compliant
    assert curve.misses(np.interp(curve.depth, picture.RESOLVED, 1.1 * truth)) == pytest.approx(0.1)


@pytest.mark.parametrize("resolved", [True, False])
def test_the_picture_is_drawn_with_resolved_contact_or_without(
    box: Vademecum,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    resolved: bool,
) -> None:
    def contacts_at(*_: Any, **__: Any) -> Any:
        if not resolved:
            raise MeshError("too large")
        return SimpleNamespace(forces=np.ones((1, 5)))

    monkeypatch.setattr(picture, "contacts_at", contacts_at)
    picture.palpation_picture(box, outline(box), tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
    assert ("too large" in capsys.readouterr().err) != resolved


# --- Resolved contacts ---------------------------------------------------------------------------


@pytest.mark.long
def test_resolved_contacts_on_a_cube_are_met_and_covered() -> None:
    """Where the step agrees with Sneddon, it also agrees with contacts resolved around it."""
    cube = organ("cube").with_certificate(
        replace(Certificate.unknown(), force_error=ForceError(1.0, 0.01))
    )
    found = with_contact_sites(cube, outline(cube), 2, 1)
    assert found.certificate is not None
    assert found.provenance.notices == ()
    sites = found.certificate.contact_sites
    assert (sites.n_contacts, sites.n_places) == (24, 2)
    assert sites.mean < 0.02
    assert sites.worst < 0.06
    assert sites.coverage >= PROMISED
