"""The command: bad input is one clear line and exit code 1; no work or file is lost."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import meshio
import nrrd
import numpy as np
import pytest
import typer

from avatar_core.atlas.patient import _timed
from avatar_core.cli import main as cli
from avatar_core.cli.timings import StageClock, require_timings, show_timings
from avatar_core.cli.vademecum import _read_tumour, _read_with_tumour, read_organ
from avatar_core.common.processes import ModuleProcess
from avatar_core.errors import AvatarError, CoordinateError, StorageError, SurfaceError
from avatar_core.fem import patch_loads as loads
from avatar_core.geometry.mesh import tetrahedralize
from avatar_core.geometry.phantom import phantom_liver
from avatar_core.geometry.surface import read_surface
from avatar_core.pipeline import OrganOptions
from avatar_core.vademecum.storage import load_vademecum
from tests.core.conftest import Command


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray) -> Path:
    lines = [f"v {x} {y} {z}" for x, y, z in vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in np.asarray(faces) + 1]
    path.write_text("\n".join(lines) + "\n")
    return path


def phantom_file(folder: Path) -> Path:
    liver = phantom_liver(12e-3)
    return write_obj(folder / "liver.obj", liver.vertices * 1e3, liver.faces)


@pytest.fixture
def refused(avatar: Command, tmp_path: Path) -> Callable[[list[object], str], None]:
    """Build with arguments that are refused in one line, without leaving files."""

    def check(arguments: list[object], remedy: str) -> None:
        before = set(tmp_path.iterdir())
        code, _, err = avatar("vademecum", *arguments, "-o", tmp_path / "v.h5")
        (line,) = [line for line in err.splitlines() if line.startswith("avatar:")]
        assert code == 1 and remedy in line
        assert set(tmp_path.iterdir()) == before

    return check


@pytest.mark.parametrize(
    ("content", "remedy"),
    [(None, "check the path"), ("v 0 0 0\nv 100 0 0\nv 0 100 0\nf 1 2 3\nf 1 3 2\n", "clos")],
    ids=["missing", "two triangles"],
)
def test_bad_surface(refused: Any, tmp_path: Path, content: str | None, remedy: str) -> None:
    source = tmp_path / "organ.obj"
    if content is not None:
        source.write_text(content)
    refused([source], remedy)


@pytest.mark.parametrize(
    ("options", "remedy"),
    [
        (["--poisson", "0.5"], "0.4999"),
        (["--young", "-1"], "positive"),
        (["--patch-radius", "1e-12"], "radius"),
        (["--vertices", "3"], "at least"),
        (["--modes", "0"], "at least 1"),
        (["--tolerance", "0"], "between"),
        (["--element", "Q8"], "P2"),
        (["--axes", "XYZ"], "axes"),
        (["--unit", "inch"], "mm"),
        (["--groups", "nothing.npz"], "node groups"),
        (["--material", "rubber"], "neo-hookean"),
        (["--material", "neo-hookean", "--max-push", "0"], "20e-3"),
        (["--material", "neo-hookean", "--poisson", "0.495"], "0.49"),
        (["--material", "neo-hookean", "--element", "P1"], "P2"),
        (["--material", "neo-hookean", "--coordinate", "poisson=0.4:0.49"], "two vademecums"),
        (["--coordinate", "poisson=0.4:0.6"], "0.4999"),
        (["--support", "bare_area=soft"], "NAME=LOW:HIGH"),
        (["--support", "bare_area=0"], "free surface"),
        (["--support", "falciform", "--material", "neo-hookean"], "two vademecums"),
        (["--support", "falciform", "--contact-sites", "3"], "one linear material"),
        (["--contact-sites", "2"], "at least 3"),
        (["--coordinate", "resection=0:1"], "--resection FILE"),
        (["--contact-sites", "3", "--material", "neo-hookean"], "one linear material"),
    ],
)
def test_bad_option(refused: Any, tmp_path: Path, options: list[str], remedy: str) -> None:
    source = phantom_file(tmp_path)
    small = [] if "--vertices" in options else ["--vertices", "800"]
    refused([source, *small, *options], remedy)


@pytest.mark.parametrize(
    ("change", "remedy"),
    [
        (None, "cannot read the resection"),
        ({"point": [1.0, 0.0, 0.0]}, "give a surface in metres through the organ"),
        ({"open_along": [1.0, 0.0, 0.0]}, "opens along its own normal"),
        # across the direction from the clamp to the front
        (
            {"normal": [0.0, -1.0, 1.0], "open_along": [1.0, 0.0, 0.0]},
            "nothing holds the first part",
        ),
    ],
    ids=["no file", "elsewhere", "along the normal", "loose"],
)
def test_bad_resection(
    refused: Any, tmp_path: Path, change: dict[str, list[float]] | None, remedy: str
) -> None:
    plane, file = tmp_path / "plane.json", phantom_file(tmp_path)
    sound = {"point": [0.0, 0.0, 0.0], "normal": [1.0, 0.0, 0.0], "open_along": [0.0, -1.0, 0.0]}
    if change is not None:
        plane.write_text(json.dumps(sound | change))
    refused([file, "--vertices", "800", "--resection", plane], remedy)


@pytest.mark.parametrize(
    ("states", "given", "read"),
    [("", None, "LPS"), ("# SPACE=RAS\n", None, "RAS"), ("", "LPI", "LPI")],
    ids=["the organ's", "its own", "those given"],
)
def test_axes_of_a_tumour(tmp_path: Path, states: str, given: str | None, read: str) -> None:
    organ = phantom_file(tmp_path)
    organ.write_text("# SPACE=LPS\n" + organ.read_text())
    tumour = tmp_path / "tumour.obj"
    tumour.write_text(states + organ.read_text().partition("\n")[2])
    surface = read_organ(str(organ), "mm", None, None)
    assert surface.axes_name == "LPS"
    assert _read_tumour(tumour, "mm", given, None, surface).axes_name == read


def test_a_tumour_in_a_label_map_lies_where_its_voxels_do(tmp_path: Path) -> None:
    """Its axes differ from those of the organ's file."""
    organ = phantom_file(tmp_path)
    organ.write_text("# SPACE=LPS\n" + organ.read_text())
    surface = read_organ(str(organ), "mm", None, None)
    values = np.zeros((12, 12, 12), np.uint8)
    values[3:9, 3:9, 3:9], values[0, 0, 0] = 4, 1
    fields = {
        "space": "LPS",
        "space directions": 3.0 * np.eye(3),
        "space origin": [20.0, 30.0, 40.0],
    }
    nrrd.write(str(tmp_path / "found.nrrd"), values, fields)
    tumour = _read_tumour(tmp_path / "found.nrrd", "mm", None, "4", surface)
    centre = 1e-3 * (np.array([20.0, 30.0, 40.0]) + 3.0 * 5.5) * [-1, -1, 1]
    np.testing.assert_allclose(tumour.vertices.mean(axis=0), centre, atol=1e-4)


@pytest.mark.parametrize("names_its_file", [True, False])
def test_an_organ_includes_the_tumour_that_was_cut_out_of_its_label(
    tmp_path: Path, names_its_file: bool
) -> None:
    values = np.full((40, 40, 40), 7, np.uint8)
    values[[0, -1]] = values[:, [0, -1]] = values[:, :, [0, -1]] = 0
    values[10:20, 10:20, 10:20] = 3
    path = tmp_path / "ct.nrrd"
    fields = {"space": "RAS", "space directions": 3.0 * np.eye(3), "space origin": [0.0, 0.0, 0.0]}
    nrrd.write(str(path), values, fields)
    given = path if names_its_file else None
    organ, lesion = _read_with_tumour(str(path), "mm", None, "7", given, "3")
    assert 1e6 * organ.volume == pytest.approx(38**3 * 0.027, rel=0.01)
    assert lesion is not None and 1e6 * lesion.volume == pytest.approx(27.0, rel=0.1)
    assert organ.notices == ("read label 7, 1,455 ml; label 3, 27 ml, inside: 100%",)
    with pytest.raises(AvatarError, match="--tumour-label is for a label map"):
        _read_with_tumour("liver.obj", "mm", None, None, None, "3")


def test_what_was_read_is_said_before_a_lesion_is_refused(avatar: Command, tmp_path: Path) -> None:
    values = np.zeros((60, 40, 40), np.uint8)
    values[1:39, 1:39, 1:39], values[45:55, 10:20, 10:20] = 7, 3
    fields = {"space": "RAS", "space directions": 3.0 * np.eye(3), "space origin": [0.0, 0.0, 0.0]}
    nrrd.write(str(tmp_path / "ct.nrrd"), values, fields)
    chosen = ["--label", "7", "--tumour-label", "3", "-o", tmp_path / "v.h5"]
    code, _, err = avatar("vademecum", tmp_path / "ct.nrrd", *chosen)
    read, refusal = err.splitlines()
    assert code == 1 and read == "notice: read label 7, 1,482 ml; label 3, 27 ml, inside: 0%"
    assert "0% of the lesion" in refusal


@pytest.mark.long
def test_tolerance_out_of_reach_is_written_and_marked(
    avatar: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(loads, "MIDPOINTS_FROM", 1.0)  # fewer load positions
    file = tmp_path / "v.h5"
    options = ["--vertices", "400", "--modes", "6", "--tolerance", "0.001", "--certify", "5"]
    code, _, err = avatar("vademecum", phantom_file(tmp_path), "-o", file, *options)
    assert code == 3 and "not converged" in err
    code, out, _ = avatar("show", file, "--json")
    shown = json.loads(out)
    assert shown["converged"] is False
    wanted = {"l2_mean", "l2_worst", "contact_mean", "contact_worst"}
    assert wanted | {"modes", "build_cpu_seconds", "bytes"} <= set(shown["certificate"])
    assert shown["certificate"]["build_cpu_seconds"] > 0


def test_show_refuses_what_is_no_vademecum(avatar: Command, tmp_path: Path) -> None:
    (tmp_path / "x.h5").write_bytes(b"nothing")
    for name in ("x.h5", "y.h5"):
        code, _, err = avatar("show", tmp_path / name)
        assert code == 1 and err.count("\n") == 1


def test_unknown_option_is_a_usage_error(avatar: Command) -> None:
    code, _, err = avatar("show", "--colour")
    assert code == 2 and "--colour" in err


def commands(group: Any, *words: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every command of a group, with the words that call it."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, *words, name)
        else:
            yield (*words, name), command


def test_help_shows_every_unit(avatar: Command) -> None:
    assert avatar("--help")[0] == 0
    n_metres = 0
    for words, command in commands(typer.main.get_command(cli.app)):
        code, out, _ = avatar(*words, "--help")
        assert code == 0 and "Usage" in out
        shown = " ".join(out.split())
        for parameter in command.params:
            units = re.findall(r"\[[^\]]+\]", parameter.help or "")
            n_metres += units.count("[m]")
            for unit in units:
                described = str(parameter.help).partition(unit)[0].split()[-1]
                assert f"{described} {unit}" in shown, (words, parameter.name)
    assert n_metres >= 5  # options of vademecum, atlas create and export


def test_ctrl_c_is_said_and_leaves_nothing(
    avatar: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def meshed_then_stopped(*_: object) -> None:
        tetrahedralize(phantom_liver(12e-3), 800)  # a library in there takes the signal for itself
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(10.0)

    source = phantom_file(tmp_path)
    monkeypatch.setattr("avatar_core.pipeline.build", meshed_then_stopped)
    # a shell starts background processes with the signal ignored
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        code, _, err = avatar("vademecum", source, "-o", tmp_path / "liver.h5")
    finally:
        signal.signal(signal.SIGINT, before)
    assert code == 130 and err.splitlines()[-1].startswith("avatar: stopped")
    assert list(tmp_path.iterdir()) == [source]


# --- Where commands write -------------------------------------------------------------------------


@pytest.fixture
def said(  # type: ignore[no-untyped-def]
    nothing_is_computed: None, avatar: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Run a command in a folder with one file of each kind, and check that they stay."""
    monkeypatch.chdir(tmp_path)
    for name in ("liver.obj", "tumour.obj", "groups.npz", "text.h5"):
        Path(name).write_text(name)
    for name, format_ in (
        ("v.h5", "avatar vademecum"),
        ("frame.h5", "avatar atlas"),
        ("foreign.h5", "something else"),
    ):
        with h5py.File(name, "w") as file:
            file.attrs["format"] = format_
    Path("folder.h5").mkdir()
    Path("link.h5").symlink_to("liver.obj")
    os.link("tumour.obj", "hard.h5")
    Path("link.json").symlink_to("liver.obj")
    Path("link.vtu").symlink_to("v.h5")
    Path("gone.h5").symlink_to("nowhere")
    Path("old.vtu").write_text("<VTKFile/>")
    Path("old.json").write_text("{}")
    before = _contents(tmp_path)

    def run(command: str) -> str:
        code, _, err = avatar(*command.split())
        assert code == 1 and _contents(tmp_path) == before
        return err.splitlines()[-1].removeprefix("avatar: ")

    return run


def _contents(folder: Path) -> dict[str, bytes | None]:
    return {path.name: path.read_bytes() if path.is_file() else None for path in folder.iterdir()}


ORGAN = "vademecum liver.obj --tumour tumour.obj --groups groups.npz -o"
PATIENT = "patient liver.obj --atlas folder.h5 -o"


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (f"{ORGAN} liver.obj", "choose .h5"),
        (f"{ORGAN} out", "choose .h5"),
        (f"{ORGAN} link.h5", "link.h5 is also read (liver.obj)"),
        (f"{ORGAN} link.h5 --overwrite", "is also read"),
        (f"{ORGAN} ../{{here}}/hard.h5", "is also read (tumour.obj)"),
        (f"{ORGAN} folder.h5", "is a folder"),
        (f"{ORGAN} folder.h5 --overwrite", "is a folder"),
        (f"{ORGAN} no/v.h5", "create it first"),
        (f"{ORGAN} text.h5", "--overwrite"),
        (f"{ORGAN} foreign.h5", "--overwrite"),
        (f"{ORGAN} gone.h5", "--overwrite"),
        (f"{ORGAN} frame.h5", "no vademecum"),
        (f"{PATIENT} liver.obj", "choose .h5"),
        (f"{PATIENT} link.h5", "is also read (liver.obj)"),
        (f"{PATIENT} text.h5", "--overwrite"),
        (f"{PATIENT} folder.h5", "is a folder"),
        ("atlas create no/a liver.obj", "create it first"),
        ("atlas create v.h5 liver.obj", "give the name of a folder"),
        ("atlas create link.h5 liver.obj", "give the name of a folder"),
        ("export v.h5 -o v.h5", "choose .vtu or .xdmf"),
        ("export v.h5 -o link.vtu", "is also read (v.h5)"),
        ("export v.h5 -o no/v.vtu", "create it first"),
        ("export v.h5 -o tumour.obj", "exists; give another name, or --overwrite"),
        ("register v.h5 --points liver.obj -o tumour.obj", "exists; give another name"),
        ("calibrate v.h5 --recording v.h5 -o old.json", "exists; give another name"),
        ("uncertainty v.h5 --given young=fixed:5e3 -o old.json", "exists; give another name"),
        ("bench step liver.obj -o liver.obj", "choose .json"),
        ("bench step liver.obj -o link.json", "is also read (liver.obj)"),
        ("bench effects liver.obj -o no/e.json", "create it first"),
        ("bench cell liver.obj -o liver.obj", "choose .json"),
        ("demo -o demo", "choose .png"),
        ("demo -o no/demo.png", "create it first"),
    ],
)
def test_refused_before_anything_is_computed(said, tmp_path, command, reason):  # type: ignore[no-untyped-def]
    assert reason in said(command.format(here=tmp_path.name))


@pytest.mark.parametrize(
    "command",
    [
        f"{ORGAN} new.h5",
        f"{ORGAN} v.h5",
        f"{ORGAN} text.h5 --overwrite",
        f"{ORGAN} gone.h5 --overwrite",
        f"{PATIENT} new.h5",
        f"{PATIENT} v.h5",
        f"{PATIENT} text.h5 --overwrite",
        "atlas create new liver.obj",
        "export v.h5 -o new.xdmf",
        "export v.h5 -o old.vtu --overwrite",
        "bench step liver.obj -o old.json",
        "bench step v.h5",
        "demo -o new.png --vertices 500",
    ],
)
def test_what_may_be_written_is_begun(said, command):  # type: ignore[no-untyped-def]
    assert said(command) == "begun"


@pytest.mark.parametrize(
    "command", [f"{ORGAN} new.h5", f"{PATIENT} new.h5", "export v.h5 -o a.vtu"]
)
def test_a_read_only_folder_is_refused(said, monkeypatch, command):  # type: ignore[no-untyped-def]
    # os.access is replaced, because the superuser may write anywhere
    monkeypatch.setattr(os, "access", lambda _, mode, **__: not mode & os.W_OK)
    assert "cannot be written to" in said(command)


# --- Times that a command prints ------------------------------------------------------------------


BUSY = "import time\nwhile time.process_time() < 0.4: pass"


def test_each_second_goes_to_the_stage_it_was_spent_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = StageClock()
    clock.begin("asleep")
    time.sleep(0.3)
    clock.begin("child")
    subprocess.run([sys.executable, "-S", "-c", BUSY], check=True)
    clock.begin("asleep")
    file = tmp_path / "times.json"
    show_timings(clock, file)
    stages = {one.stage: one for one in clock.stages}
    assert list(stages) == ["start", "asleep", "child"]
    assert stages["asleep"].seconds > 0.29 > 0.2 > stages["asleep"].cpu_seconds
    assert stages["child"].cpu_seconds > 0.35
    assert json.loads(file.read_text()) == [vars(one) for one in clock.stages]
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 5
    assert lines[-1].split()[:2] == ["all", f"{sum(s.cpu_seconds for s in clock.stages):.2f}"]


def test_stages_of_a_patient_count_their_processes() -> None:
    clock: dict[str, float] = {}
    with _timed(clock, "mesh"):
        subprocess.run([sys.executable, "-S", "-c", BUSY], check=True)
    assert clock["mesh"] > 0.35


def test_reports_pass_through_and_set_the_stage() -> None:
    heard: list[tuple[str, float, float]] = []
    clock = StageClock()
    report = clock.following(lambda *news: heard.append(news))
    report("mesh", 0.0, 0.5)
    report("mesh", 1.0, 0.5)
    report("solve", 0.0, 0.5)
    assert heard == [("mesh", 0.0, 0.5), ("mesh", 1.0, 0.5), ("solve", 0.0, 0.5)]
    assert [one.stage for one in clock.stages] == ["start", "mesh"]


def test_a_file_that_cannot_be_written_is_refused_first(tmp_path: Path) -> None:
    for file in (tmp_path / "times.txt", tmp_path / "missing" / "times.json"):
        with pytest.raises(StorageError, match=r"choose|create"):
            require_timings(file, ())
    plane = tmp_path / "plane.json"
    plane.touch()
    with pytest.raises(StorageError, match="is also read"):
        require_timings(plane, [plane])


def test_what_would_be_ignored_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CoordinateError, match="--tumour"):
        OrganOptions(contrast=4.0)
    lesion = phantom_liver(12e-3)
    with pytest.raises(CoordinateError, match=r"give 0\.01 to 100"):
        OrganOptions(contrast=1e6, tumour=lesion)
    meshio.write_points_cells(tmp_path / "o.stl", lesion.vertices, {"triangle": lesion.faces})
    with pytest.raises(SurfaceError, match="has no label 1"):
        read_surface(tmp_path / "o.stl", "m", label=1)


# --- The same file gives the same vademecum -------------------------------------------------------


@pytest.mark.long
def test_the_same_surface_gives_the_same_vademecum(livers_dir: Path, tmp_path: Path) -> None:
    """Builds on one and two threads, in separate processes, agree bit for bit except for times."""
    built = [tmp_path / f"{n}.h5" for n in (1, 2)]
    processes = [
        ModuleProcess(
            "avatar_core.cli.main",
            *("vademecum", str(livers_dir / "LiTS-4.obj"), "-o", str(path)),
            *("--vertices", "600", "--certify", "10"),
            n_threads=n,
            environment={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        for n, path in enumerate(built, start=1)
    ]
    assert [process.wait() for process in processes] == [0, 0]
    one, other = map(load_vademecum, built)
    assert one.id == other.id
    assert one.certificate is not None and other.certificate is not None
    assert one.certificate.l2_mean == other.certificate.l2_mean
