"""Bad surfaces are skipped and named; processes and a cluster give the same atlas."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar_core.atlas import growth as atlas_build
from avatar_core.atlas.anatomy import AtlasError, WholeAnatomy
from avatar_core.atlas.growth import SurfaceFile, create_atlas
from avatar_core.atlas.storage import load_atlas
from avatar_core.atlas.workers import Workers
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.registration import Template, TemplateRule
from tests.core.atlas.rough import ALONE, OPTIONS, write_obj

# --- bad surfaces -----------------------------------------------------------------------------


def test_bad_surfaces_are_skipped(
    template: Template, livers: list[SurfaceMesh], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    register_template = atlas_build.register_template

    def sometimes(template: Template, surface: SurfaceMesh, rule: TemplateRule):
        if surface.name == "liver1":
            raise np.linalg.LinAlgError("singular")
        return register_template(template, surface, rule)

    monkeypatch.setattr(atlas_build, "register_template", sometimes)
    half = replace(livers[0], faces=livers[0].faces[: len(livers[0].faces) // 2], name="half")
    sources = [
        SurfaceFile(write_obj(tmp_path / "half.obj", half)),
        livers[1],
        SurfaceFile(tmp_path / "missing.obj"),
        replace(livers[2], vertices=3 * livers[2].vertices),
        livers[3],
    ]
    growth = create_atlas(tmp_path / "atlas", sources, OPTIONS, template=template, workers=ALONE)
    assert growth.added == ("liver3",) == load_atlas(tmp_path / "atlas").names
    assert [one.name for one in growth.skipped] == ["half", "liver1", "missing", "liver2"]
    reasons = [one.reason for one in growth.skipped]
    words = ("open", "LinAlgError", "check the path", "--box")
    for reason, word in zip(reasons, words, strict=True):
        assert word in reason and "\n" not in reason


# --- many at once -----------------------------------------------------------------------------


def test_processes_give_the_same_atlas(
    template: Template, livers: list[SurfaceMesh], members: list[WholeAnatomy], tmp_path: Path
) -> None:
    threads = os.environ.get("OMP_NUM_THREADS")
    file = tmp_path / "atlas"
    growth = create_atlas(file, livers[:2], OPTIONS, template=template, workers=Workers(jobs=2))
    assert growth.added == ("liver0", "liver1")
    # the number of threads changes the order of sums: rounding, through a converged iteration
    for one, other in zip(load_atlas(file).vectors, members, strict=False):
        np.testing.assert_allclose(one, other.distances, atol=1e-6)
    assert os.environ.get("OMP_NUM_THREADS") == threads


def test_a_process_that_dies_costs_its_own_result_only() -> None:
    work = ["1 + 1", "__import__('os')._exit(1)", "2 + 2"]
    results = dict(Workers(jobs=2).map(eval, work))
    assert results[0] == 2 and results[2] == 4
    assert isinstance(results[1], RuntimeError) and "memory" in str(results[1])


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Start a real scheduler and two worker processes."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=None
    ) as running:
        yield running


@pytest.mark.long  # its processes take longer to start than to work
def test_a_cluster_builds_too_though_a_worker_is_killed(
    template: Template,
    livers: list[SurfaceMesh],
    members: list[WholeAnatomy],
    tmp_path: Path,
    cluster: Any,
) -> None:
    source = SurfaceFile(write_obj(tmp_path / "liver0.obj", livers[0]))
    missing = SurfaceFile(tmp_path / "missing.obj")
    killed: list[int] = []

    def kill_one(done: int, total: int, name: str) -> None:
        if name != "missing" and not killed:  # half way: both are at work
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

    growth = create_atlas(
        tmp_path / "atlas",
        [source, *livers[1:4], missing],
        OPTIONS,
        template=template,
        workers=Workers(scheduler=cluster.scheduler_address),
        progress=kill_one,
    )
    assert killed and growth.added == ("liver0", "liver1", "liver2", "liver3")
    assert [one.name for one in growth.skipped] == ["missing"]
    # the OBJ holds its coordinates to the last digit, in mm
    for one, other in zip(growth.atlas.vectors, members, strict=False):
        np.testing.assert_allclose(one, other.distances, atol=1e-6)


@pytest.mark.long  # the scheduler tries it on four workers, each of which must start again
def test_a_task_that_kills_every_worker_costs_its_own_result_only(
    cluster: Any, tmp_path: Path
) -> None:
    def noted(name: str, value: int) -> str:
        return f"(__import__('pathlib').Path({str(tmp_path / name)!r}).touch(), {value})[1]"

    # last, and well after the others: tasks on a dying worker are blamed alike
    done = f"len(__import__('os').listdir({str(tmp_path)!r})) == 2"
    pause = "__import__('time').sleep"
    last = (
        f"[{pause}(0.1) for _ in range(200) if not {done}], {pause}(2), __import__('os')._exit(1)"
    )
    work = [noted("first", 2), last, noted("last", 4)]
    results = dict(Workers(scheduler=cluster.scheduler_address).map(eval, work))
    assert results[0] == 2 and results[2] == 4
    assert type(results[1]).__name__ == "KilledWorker"


def test_without_dask_the_extra_is_named(
    template: Template, livers: list[SurfaceMesh], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    workers = Workers(scheduler="tcp://127.0.0.1:1")
    with pytest.raises(AtlasError, match=r"\.\[cluster\]"):
        create_atlas(tmp_path / "atlas", livers[:1], OPTIONS, template=template, workers=workers)
    assert not any(tmp_path.iterdir())
