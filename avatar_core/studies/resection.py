"""Error of the coordinate of a resection: opened values that no build has seen.

A plane through the centroid divides each liver into a left and a right part; the cut opens from
the front backwards. The truth is full finite elements on the same cut mesh, under loads at face
centroids. At 0 the rival is the vademecum of the whole organ on the mesh before it is cut.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from avatar_core.certify.linear import measured
from avatar_core.fem.elasticity import Elasticity, Material
from avatar_core.fem.norms import relative_l2
from avatar_core.fem.patch_loads import load_surface, patch_loads
from avatar_core.fem.resection import Resection
from avatar_core.geometry.cut_surface import CutSurface
from avatar_core.geometry.cutting import cut, snapped
from avatar_core.geometry.mesh import regions_by_rule, tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.offline.rule import BuildRule
from avatar_core.reduction.coordinates import RESECTION, Coordinate, problem_at
from avatar_core.studies.organ import Organ
from avatar_core.studies.shapes import read_liver
from avatar_core.studies.study import ProgressBar, Row, Run, Study, column, label, where
from avatar_core.vademecum.modal_mass import sag_of
from avatar_core.vademecum.model import Vademecum

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COORDINATE = Coordinate(RESECTION, 0.0, 1.0)
LIMITS = {"mean": 0.03, "worst": 0.08}  # of the L2 error at unseen values


@dataclass(frozen=True)
class ResectionSettings:
    """Sizes of the study.

    n_vertices : approximate number of mesh vertices
    between : unseen values, as fractions of the way from one stored value to the next
    n_loads : unseen loads at each value
    """

    n_vertices: int = 2850
    between: tuple[float, ...] = (0.1, 0.25, 0.5, 0.75)
    n_loads: int = 40


class ResectionStudy(Study[ResectionSettings]):
    """The phantom and LiTS-4."""

    name = "resection"
    full = ResectionSettings()
    quick = ResectionSettings(1000, (0.1, 0.5), 24)

    def measure(self, run: Run[ResectionSettings]) -> None:
        surfaces = [phantom_liver(), read_liver(run.surfaces, "LiTS-4")]
        if surfaces[1].name == surfaces[0].name:
            run.notices.append("no folder of livers (--surfaces): the phantom alone")
            del surfaces[1]
        with ProgressBar(len(surfaces)) as bar:
            for surface in surfaces:
                progress = bar.begin(surface.name)
                organ, whole = resected(surface, run.settings.n_vertices)
                vademecum = organ.parametric((COORDINATE,), BuildRule(), progress)
                at_zero = whole.linear(BuildRule(), progress)
                run.rows.append(_whole_row(vademecum, at_zero, surface.name))
                run.rows += _rows(vademecum, organ, run.settings)

    def summary(self, run: Run[ResectionSettings]) -> dict[str, float]:
        """Return the worst errors over both organs."""
        unseen = where(run.rows, kind="opened", stored=False)
        stored, whole = where(run.rows, stored=True), where(run.rows, kind="whole")
        return {
            "unseen_l2_mean": float(np.max(_of_organs(unseen, "l2_mean"))),
            "unseen_l2_worst": float(column(unseen, "l2_worst").max()),
            "unseen_contact_mean": float(np.max(_of_organs(unseen, "contact_mean"))),
            "unseen_sag_worst": float(column(unseen, "sag").max()),
            "stored_l2_mean": float(np.max(_of_organs(stored, "l2_mean"))),
            "stored_l2_worst": float(column(stored, "l2_worst").max()),
            "at_0_from_whole_l2_mean": float(column(whole, "l2_mean").max()),
            "at_0_from_whole_contact_mean": float(column(whole, "contact_mean").max()),
            "opened_from_whole_l2_mean": float(column(stored, "from_whole").max()),
        }

    def sentence(self, run: Run[ResectionSettings]) -> str:
        s = run.summary
        return (
            f"Between six stored openings the displacement is {s['unseen_l2_mean']:.1%} off full "
            f"finite elements (worst {s['unseen_l2_worst']:.1%}); uncut it is "
            f"{s['at_0_from_whole_l2_mean']:.1%} off the whole organ's vademecum, while opening "
            f"changes it by {s['opened_from_whole_l2_mean']:.0%}."
        )

    def draw(self, figure: Figure, run: Run[ResectionSettings]) -> None:
        left, right = figure.subplots(1, 2)
        for name in dict.fromkeys(str(row["organ"]) for row in run.rows):
            some = where(run.rows, kind="opened", organ=name)
            some = sorted(some, key=lambda row: float(row["opened"] or 0.0))
            opened, stored = column(some, "opened"), column(some, "stored") > 0.0
            for key, style in (("mean", "-"), ("worst", ":")):
                error = column(some, f"l2_{key}")
                (line,) = left.plot(opened, error, style, label=f"{name}, {key}")
                left.plot(opened[stored], error[stored], "o", color=line.get_color(), ms=4)
            right.plot(opened, column(some, "from_whole"), "o-", ms=3, label=f"{name}, loads")
            right.plot(opened, column(some, "sag_from_whole"), "o:", ms=3, label=f"{name}, weight")
        for key, limit in LIMITS.items():
            left.axhline(limit, color="tab:gray", lw=0.8)
            left.annotate(f"{key} asked for", (0.02, limit), fontsize=7, va="bottom")
        x, what = "opened part of the cut [-]", "relative L2 {} of displacement [-]"
        label(left, x, what.format("error"), "unseen loads; dots: stored openings")
        label(right, x, what.format("change"), "what opening changes, against the whole organ")


STUDY = ResectionStudy()


def resected(surface: SurfaceMesh, n_vertices: int) -> tuple[Organ, Organ]:
    """Return an organ cut through its centroid, and the same before the cut."""
    mesh = tetrahedralize(surface, n_vertices)
    x, y, z = map(float, mesh.centroid)
    plane = CutSurface((0.0, -1.0, 0.0), (x, y, z), (1.0, 0.0, 0.0))
    whole, second = snapped(mesh, plane)
    regions, opened = regions_by_rule(whole), cut(whole, second)
    resection = Resection.of(opened, plane, Material().young_modulus)
    problems = (
        Elasticity(opened, Material(), regions.clamped, resection=resection),
        Elasticity(whole, Material(), regions.clamped),
    )
    one, other = (
        Organ(surface, regions, load_surface(problem.mesh, regions), problem)
        for problem in problems
    )
    return one, other


def _whole_row(vademecum: Vademecum, whole: Vademecum, name: str) -> Row:
    """Compare the vademecum at 0 with the whole organ's, at all load positions."""
    n, mass = 3 * len(whole.mesh.vertices), whole.mesh.lumped_mass
    l2, contact = [], []
    for j in range(0, whole.surface.n_positions, 5):
        at = np.array([j]), np.ones(1)
        l2.append(relative_l2(vademecum.displacement(*at)[:n], whole.displacement(*at), mass))
        exact = whole.compliance(*at)
        contact.append(np.linalg.norm(vademecum.compliance(*at) - exact) / np.linalg.norm(exact))
    found = {"l2_mean": float(np.mean(l2)), "contact_mean": float(np.mean(contact))}
    return {"kind": "whole", "organ": name, "l2_worst": float(np.max(l2)), **found}


def _rows(vademecum: Vademecum, organ: Organ, settings: ResectionSettings) -> list[Row]:
    """Return errors at stored values and between them, for loads and for the organ's sag."""
    last = COORDINATE.n_nodes - 1
    steps = [k + part for k in range(last) for part in (0.0, *settings.between)] + [float(last)]
    rows: list[Row] = []
    mass = vademecum.mesh.lumped_mass
    whole = _truths(vademecum, organ.elasticity, settings.n_loads)
    for k, step in enumerate(steps):
        opened = step / last
        here = vademecum.at(resection=opened)
        problem = problem_at(organ.elasticity, {RESECTION: opened})
        found = measured(here, problem, settings.n_loads, seed=k)
        loads, sag = _truths(vademecum, problem, settings.n_loads)
        assert here.body is not None
        ours = here.far.space.astype(float) @ here.body.weight
        rows.append(
            {
                "kind": "opened",
                "organ": organ.outline.name,
                "opened": opened,
                "stored": step == int(step),
                "l2_mean": float(found.l2.mean()),
                "l2_worst": float(found.l2.max()),
                "contact_mean": float(found.contact.mean()),
                "contact_worst": float(found.contact.max()),
                "sag": float(relative_l2(ours, sag, mass).max()),
                "from_whole": float(relative_l2(loads, whole[0], mass).mean()),
                "sag_from_whole": float(relative_l2(sag, whole[1], mass).mean()),
            }
        )
    return rows


def _truths(
    vademecum: Vademecum, problem: Elasticity, n_loads: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return full solutions at the vertices: under some loads of the build, and unit weights."""
    surface = vademecum.surface
    some = np.linspace(0, surface.n_positions - 1, n_loads).astype(int)
    loads = patch_loads(problem, surface.centers[some], surface.patch_radius)
    return problem.at_vertices(problem.solve(loads)), problem.at_vertices(sag_of(problem)[1])


def _of_organs(rows: list[Row], key: str) -> list[float]:
    """Return a mean of a column for each organ."""
    names = dict.fromkeys(row["organ"] for row in rows)
    return [float(column(where(rows, organ=name), key).mean()) for name in names]
