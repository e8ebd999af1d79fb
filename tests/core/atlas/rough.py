"""A small atlas with a rough registration: options, and what tests do with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from avatar_core.atlas.anatomy import WholeAnatomy
from avatar_core.atlas.frame import Frame
from avatar_core.atlas.growth import AtlasOptions, _hash_of_options
from avatar_core.atlas.model import Atlas
from avatar_core.atlas.storage import load_atlas, save_anatomy, save_frame
from avatar_core.atlas.workers import Workers
from avatar_core.geometry.mesh import TetMesh, regions_by_rule
from avatar_core.geometry.phantom import phantom_liver, population
from avatar_core.geometry.surface import SurfaceMesh
from avatar_core.shapes.registration import Template, TemplateRule

# a rough registration, 0.3 s instead of 6 s: the atlas treats it alike
ROUGH = TemplateRule(
    n_stages=5, last_sweeps=0, n_samples=800, largest_mean=2e-3, largest_reverse_mean=5e-3
)
OPTIONS = AtlasOptions(spacing=0.02, rule=ROUGH)
ALONE = Workers(jobs=1)
N = 6

Command = Callable[..., tuple[int, str, str]]  # arguments to exit code, output and errors


def make_template(mesh: TetMesh) -> Template:
    return Template("phantom", mesh, regions_by_rule(mesh))


def make_livers(n: int) -> list[SurfaceMesh]:
    coarse = phantom_liver(12e-3)
    maps = population(n, seed=3)
    return [replace(f.moved(coarse), name=f"liver{i}") for i, f in enumerate(maps)]


def write_obj(path: Path, surface: SurfaceMesh) -> Path:
    lines = [f"v {x} {y} {z}" for x, y, z in surface.vertices * 1e3]
    lines += [f"f {a} {b} {c}" for a, b, c in surface.faces + 1]
    path.write_text("\n".join(lines) + "\n")
    return path


def written(folder: Path, frame: Frame, members: Sequence[WholeAnatomy]) -> Atlas:
    """Write an atlas to disk, as `create_atlas` with the same options begins and fills it."""
    folder.mkdir()
    save_frame(folder, frame, _hash_of_options(OPTIONS, frame.template))
    for member in members:
        save_anatomy(folder, member)
    return load_atlas(folder)


def same(one: Atlas, other: Atlas) -> bool:
    """Return whether two atlases hold the same, bit for bit."""
    return one.names == other.names and all(
        np.array_equal(one.vectors[i], other.vectors[i])
        and np.array_equal(a.registered, b.registered)
        and np.array_equal(a.alignment.rotation, b.alignment.rotation)
        and (a.quality, a.origin, a.key) == (b.quality, b.origin, b.key)
        for i, (a, b) in enumerate(zip(one.anatomies, other.anatomies, strict=True))
    )


def files_of(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Return time of writing and content of every file of an atlas."""
    return {
        str(file.relative_to(folder)): (file.stat().st_mtime_ns, file.read_bytes())
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


class StopError(Exception):
    """Exception that interrupts a build in these tests."""


def stop_after(n: int) -> Callable[[int, int, str], None]:
    def progress(done: int, total: int, name: str) -> None:
        if done == n:
            raise StopError

    return progress
