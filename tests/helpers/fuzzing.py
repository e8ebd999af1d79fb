"""Mutated files given to the loaders, in processes that may die, and the outcome for each.

    python tests/helpers/fuzzing.py DOOR FIRST LAST [FOLDER]

Opens mutants one after another, as a node does: confined to another process. Each seed prints a
line of JSON. The line begins before the file is opened, so that it shows if this process dies. The
mutants are kept in FOLDER, if given.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

OUTCOMES = ("loaded", "refused")
SECONDS = 4.0  # time limit for reading, as in a node
PATIENCE = 90.0  # limit that includes a restart of the reading process on a busy machine
MEMORY = 2 << 30  # limit for the reading process [bytes]
LONGEST_LINE = 600


@dataclass(frozen=True)
class Campaign:
    """Outcomes of many mutants.

    door : a key of DOORS
    results : for each seed, the outcome and its message
    """

    door: str
    results: dict[int, dict[str, Any]]

    @property
    def counts(self) -> Counter[str]:
        """Return the number of mutants by outcome."""
        return Counter(result["outcome"] for result in self.results.values())

    def failures(self) -> list[str]:
        """List mutants neither loaded nor properly refused, with the command to repeat each."""
        return [
            f"{result['outcome']} ({result['message'][:100]}): python tests/helpers/fuzzing.py "
            f"{self.door} {seed} {seed + 1} FOLDER"
            for seed, result in self.results.items()
            if result["outcome"] not in OUTCOMES
        ]


def campaign(door: str, seeds: range) -> Campaign:
    """Open all mutants at a door; when the process dies, record that and start another."""
    results: dict[int, dict[str, Any]] = {}
    while len(results) < len(seeds):
        first = seeds.start + len(results)
        child = subprocess.run(
            [sys.executable, __file__, door, str(first), str(seeds.stop)],
            capture_output=True,
            text=True,
        )
        for line in child.stdout.splitlines():
            result = _result(line, f"ended with {child.returncode}: {child.stderr[-300:]}")
            results[result["seed"]] = result
        if seeds.start + len(results) == first:
            raise AssertionError(f"{door} {first} did not start: {child.stderr[-500:]}")
    return Campaign(door, results)


def _result(line: str, end: str) -> dict[str, Any]:
    try:
        return dict(json.loads(line))
    except ValueError:  # the last line: the process died before finishing it
        seed = int(line.split(":")[1].split(",")[0])
        return {"seed": seed, "outcome": "died", "message": end}


@dataclass(frozen=True)
class Door:
    """A loader under test.

    make : returns suffix and bytes of a mutant
    read : opens the mutant's file
    check : checks the result
    """

    make: Callable[[int], tuple[str, bytes]]
    read: Callable[[Path], Any]
    check: Callable[[Any], None]


def _confined(function: Callable[[Path], Any], make: Any, check: Callable[[Any], None]) -> Door:
    """Return a door whose file is read in another process."""
    from avatar_core.common.confined import Confined

    return Door(make, partial(Confined(MEMORY).call, SECONDS, function), check)


def _vademecum_bytes(seed: int) -> tuple[str, bytes]:
    from tests.helpers.file_mutations import mutant

    return "h5", mutant("vademecum", seed)


def _require_vademecum(vademecum: Any) -> None:
    import numpy as np

    assert all(np.isfinite(a).all() for a in (vademecum.far.space, vademecum.field.load))
    assert vademecum.surface_faces.max() < len(vademecum.surface_vertices)
    assert vademecum.info().name.isprintable()


def _vademecum() -> Door:
    from avatar_core.vademecum.storage import load_vademecum

    return _confined(load_vademecum, _vademecum_bytes, _require_vademecum)


def _step() -> Door:
    """Load a vademecum and also touch it, with compiled code."""
    import numpy as np

    from avatar_core.geometry.tip import Tip
    from avatar_core.vademecum.storage import load_vademecum
    from tests.helpers.contact import prepare, step
    from tests.helpers.small_files import RADIUS, small_vademecum

    directions = small_vademecum().surface.normals
    for large in (False, True):  # compiled before the clock starts
        step(
            prepare(small_vademecum(False, large), (Tip("sphere", 5e-3),), cloud="volume"),
            directions[:1],
        )

    def touch(vademecum: Any) -> None:
        _require_vademecum(vademecum)
        with np.errstate(all="ignore"):
            try:
                data = prepare(vademecum, (Tip("sphere", 5e-3),), cloud="volume")
            except (ArithmeticError, ValueError, IndexError, np.linalg.LinAlgError):
                return  # a contact node refuses it with this error's message
        for direction in directions:
            for height in (4e-3, 2e-3, -50e-3):
                step(data, (direction * (RADIUS + height))[None])

    return _confined(load_vademecum, _vademecum_bytes, touch)


def _atlas() -> Door:
    """Load an atlas with one mutated file, which the mutant's name tells."""
    import numpy as np

    from tests.helpers.file_mutations import ATLAS_FILES, mutant

    def make(seed: int) -> tuple[str, bytes]:
        kind = ATLAS_FILES[seed % len(ATLAS_FILES)]
        return kind, mutant(kind, seed // len(ATLAS_FILES))

    def check(found: tuple[list[Any], list[Any]]) -> None:
        anatomies, arrays = found
        for anatomy in anatomies:
            assert np.isfinite(anatomy.registered).all() and anatomy.name.isprintable()
        assert all(np.isfinite(array).all() for array in arrays)

    return _confined(_read_atlas_with, make, check)


def _read_atlas_with(mutant: Path) -> tuple[list[Any], list[Any]]:
    """Read anatomies, distances and responses of the small atlas with one file replaced."""
    from avatar_core.atlas.storage import FRAME, load_atlas
    from tests.helpers.file_mutations import write_small_atlas

    kind = mutant.name.partition(".")[2]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name, "atlas")
        write_small_atlas(folder)
        own = folder / FRAME if kind == FRAME else folder / "ball-1" / kind
        own.write_bytes(mutant.read_bytes())
        atlas = load_atlas(folder)
        arrays = [atlas.read_distances(one) for one in atlas.anatomies]
        responses = [atlas.read_response(one) for one in atlas.anatomies if one.response]
        return list(atlas.anatomies), [*arrays, *(one.space for one in responses)]


def _require_surface(surface: Any) -> None:
    import numpy as np

    assert np.isfinite(surface.vertices).all() and surface.faces.max() < len(surface.vertices)
    assert 0.05 <= surface.extent.max() <= 0.5


def _surface() -> Door:
    from avatar_core.geometry.surface import read_surface
    from tests.helpers.mesh_mutations import mutant

    return _confined(read_surface, mutant, _require_surface)


def _loader() -> Door:
    """Load a vademecum as load_vademecum answers a request."""
    from std_msgs.msg import Header

    from avatar_core.vademecum.storage import parse_vademecum
    from avatar_ros.framework import conversions
    from avatar_ros.framework.library import read_in_library
    from avatar_ros.framework.reader import Reader

    reader = Reader(MEMORY // 8)

    def read(path: Path) -> Any:
        data = read_in_library(path.name, str(path.parent), 10**9)
        return reader.read(path.name, len(data), parse_vademecum, data, path.name)

    def check(vademecum: Any) -> None:
        _require_vademecum(vademecum)
        conversions.vademecum_info(asdict(vademecum.info()), Header())
        conversions.surface_mesh(vademecum.surface_vertices, vademecum.surface_faces)

    return Door(_vademecum_bytes, read, check)


def _patient() -> Door:
    """Read a file as interpolate_patient's process does; every fifth as an inline mesh."""
    from types import SimpleNamespace

    from avatar_interfaces.srv import InterpolatePatient
    from avatar_ros.framework import conversions
    from avatar_ros.framework.reader import Reader
    from avatar_ros.nodes.patient_interpolation import patient_request
    from avatar_ros.patients.surface import read_confined
    from tests.helpers.mesh_mutations import altered_soup, mutant

    reader = Reader(MEMORY // 8)

    def read(path: Path) -> Any:
        settings = SimpleNamespace(library_dir=str(path.parent), max_bytes=10**6)
        request = InterpolatePatient.Request(surface=path.name, name="patient")
        seed = int(path.name.partition(".")[0])
        if seed % 5 == 0:
            soup = altered_soup(seed)
            request = InterpolatePatient.Request(name="patient")
            request.mesh = conversions.surface_mesh(soup.vertices * 1e-3, soup.faces % 2**32)
        return read_confined(patient_request(request, settings), reader)  # type: ignore[arg-type]

    return Door(mutant, read, _require_surface)


def _every() -> Door:
    """Use the core's doors in turn, so that they share the slow imports."""
    doors = (_vademecum(), _atlas(), _surface())
    turn = 0

    def make(seed: int) -> tuple[str, bytes]:
        nonlocal turn
        turn = seed % len(doors)
        return doors[turn].make(seed // len(doors))

    return Door(make, lambda path: doors[turn].read(path), lambda made: doors[turn].check(made))


DOORS: dict[str, Callable[[], Door]] = {
    "every": _every,
    "vademecum": _vademecum,
    "step": _step,
    "atlas": _atlas,
    "surface": _surface,
    "loader": _loader,
    "patient": _patient,
}


def open_one(door: Door, seed: int, folder: Path) -> dict[str, Any]:
    """Open a mutant; return the outcome "loaded", "refused" or a failure, and its message."""
    from avatar_core.errors import AvatarError

    suffix, content = door.make(seed)
    path = folder / f"{seed}.{suffix}"
    path.write_bytes(content)
    signal.setitimer(signal.ITIMER_REAL, PATIENCE)  # unhandled, so that it ends the process
    outcome, message = "loaded", ""
    try:
        door.check(door.read(path))
    except AvatarError as error:
        outcome, message = "refused", str(error)
        if not message.isprintable() or not 10 < len(message) < LONGEST_LINE:
            outcome = "refused in other than one short line"
    except Exception as error:
        outcome, message = f"raised {type(error).__name__}", str(error)
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    return {"outcome": outcome, "message": message[:LONGEST_LINE]}


def main(name: str, first: int, last: int, keep: str = "") -> int:
    warnings.simplefilter("ignore")
    door = DOORS[name]()
    with tempfile.TemporaryDirectory() as own:
        folder = Path(keep or own)
        for seed in range(first, last):
            print(f'{{"seed": {seed}, ', end="", flush=True)
            print(json.dumps(open_one(door, seed, folder))[1:], flush=True)
    return 0


if __name__ == "__main__":
    # modules are named from the top, and an installed package comes before the sources
    sys.path[:1] = []
    sys.path.append(str(Path(__file__).resolve().parents[2]))
    raise SystemExit(main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), *sys.argv[4:]))
