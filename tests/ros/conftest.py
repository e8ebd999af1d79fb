"""A cell of real processes over real DDS, in a domain of its own, on this machine only."""

from __future__ import annotations

import fcntl
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from tests.helpers.disk_cache import cached_on_disk
from tests.helpers.slowness import Deadline, slowness

_DOMAINS = range(1, 102)  # DDS domain ids that work on every platform
TIP_RADIUS = 0.005  # [m]
# for a contact node: a test may pause its poses for longer than a driver
PATIENT = ["--ros-args", "-p", "pose_timeout:=0.5"]
START_TIMEOUT = 120.0  # for a process to start, with compilation, on a busy machine [s]
DISCOVERY = 0.3  # for a client to be discovered by its service [s]
JOINING = 5.0  # time after which a node that joined counts as having missed something [s]
ASK_AGAIN = 2.0  # time after which an answer counts as lost [s]
TOUCH_DEPTH = 0.004  # [m]


def until_calm(longest: float = 2.0) -> None:
    """Wait until no thread of the middleware is at work in this process.

    If a participant ends while it is told of another one, it waits forever (Fast DDS, issue 6513).
    This is more likely on a busy machine.
    """
    end = time.monotonic() + longest
    while _at_work() and time.monotonic() < end:
        time.sleep(1e-3)


def _at_work() -> bool:
    for task in Path("/proc/self/task").iterdir():
        with suppress(OSError):  # it has ended
            name, _, rest = (task / "stat").read_text().rpartition(")")
            if "(dds." in name and rest.split()[0] == "R":
                return True
    return False


class Probe:
    """Node in the test's own process that listens and asks."""

    def __init__(self) -> None:
        import rclpy

        self._context = rclpy.Context()
        self._context.init()
        self.node = rclpy.create_node("probe", context=self._context)
        self._executor = rclpy.executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._clients: dict[tuple[type, str], Any] = {}

    def close(self) -> None:
        self._executor.shutdown()
        for subscription in list(self.node.subscriptions):
            self.node.destroy_subscription(subscription)
        until_calm()
        self.node.destroy_node()
        self._context.try_shutdown()

    def spin(self, seconds: float) -> None:
        self.until(lambda: False, seconds, fail=False)

    def until(self, reached: Callable[[], bool], timeout: float, fail: bool = True) -> None:
        passed = Deadline(timeout) if fail else None
        end = time.monotonic() + timeout
        while not reached():
            if passed is None and time.monotonic() > end:
                return
            assert not passed, f"not reached within {timeout:g} s"
            self._executor.spin_once(timeout_sec=0.01)

    def next(
        self,
        kind: type,
        topic: str,
        qos: Any,
        wanted: Callable[[Any], bool] = lambda message: True,
        timeout: float = START_TIMEOUT,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> Any:
        """Return the next message that is ``wanted``; call ``meanwhile`` while waiting."""
        found: list[Any] = []
        subscription = self.node.create_subscription(
            kind, topic, lambda message: found.append(message) if wanted(message) else None, qos
        )
        passed = Deadline(timeout)
        try:
            while not found:
                assert not passed, f"no such {topic} within {timeout:g} s"
                meanwhile()
                self._executor.spin_once(timeout_sec=0.002)
        finally:
            self.node.destroy_subscription(subscription)
        return found[0]

    def call(self, kind: type, name: str, request: Any) -> Any:
        """Return the answer to a request that may change something: it is sent once."""
        client = self.client(kind, name)
        answer = client.call_async(request)
        self.until(answer.done, START_TIMEOUT)
        return answer.result()

    def ask(self, kind: type, name: str, request: Any) -> Any:
        """Return the answer to a question: it is asked again as long as no answer came."""
        client, asked = self.client(kind, name), []
        passed = Deadline(START_TIMEOUT)
        while not passed:
            asked.append(client.call_async(request))
            self.until(lambda: any(answer.done() for answer in asked), ASK_AGAIN, fail=False)
            for answer in asked:
                if answer.done():
                    return answer.result()
        raise AssertionError(f"{name} did not answer within {START_TIMEOUT:g} s")

    def client(self, kind: type, name: str) -> Any:
        """Return a client whose service is there and had the time to discover the client.

        A service drops the answer to a client that it has not discovered within 100 ms
        (rmw_fastrtps, issue 842). Clients are kept, so that this wait happens once; it grows with
        the
        number of processes per core.
        """
        if (kind, name) not in self._clients:
            client = self._clients[kind, name] = self.node.create_client(kind, name)
            self.until(client.service_is_ready, START_TIMEOUT)
            crowd = os.getloadavg()[0] / len(os.sched_getaffinity(0))
            self.spin(DISCOVERY * min(max(1.0, crowd), 5.0))
        client = self._clients[kind, name]
        self.until(client.service_is_ready, START_TIMEOUT)
        return client


@contextmanager
def newcomer(knows: Callable[[Any], bool]) -> Iterator[Probe]:
    """Make a probe whose node discovered what it must know; if none does, the last that joined.

    A node that joins may miss another node's announcements for good: then one more joins.
    """
    passed = Deadline(START_TIMEOUT)
    while True:
        with closing(Probe()) as probe:
            patience = JOINING * slowness()
            probe.until(lambda probe=probe: knows(probe.node), patience, fail=False)
            if knows(probe.node) or passed:
                probe.spin(DISCOVERY)  # a test should see the rest too
                yield probe
                return


IS_MISSING = any(
    find_spec(name) is None for name in ("rclpy", "avatar_ros", "avatar_ros.framework")
)
collect_ignore_glob = ["*"] if IS_MISSING else []


@pytest.hookimpl(tryfirst=True)  # before pytest looks at markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.is_relative_to(Path(__file__).parent):
            item.add_marker(pytest.mark.ros)


def pytest_sessionfinish(session: pytest.Session, exitstatus: int) -> None:
    """Accept that none of these tests is collected when they run alone without ROS."""
    if exitstatus == pytest.ExitCode.NO_TESTS_COLLECTED and IS_MISSING:
        session.exitstatus = pytest.ExitCode.OK


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if IS_MISSING:
        terminalreporter.line("tests/ros is left out: ROS 2 or avatar_ros is not installed")


@contextmanager
def free_domain() -> Iterator[int]:
    """Reserve a DDS domain that no other worker or run of these tests on this machine uses."""
    first = os.getpid() % len(_DOMAINS)
    for number in (*_DOMAINS[first:], *_DOMAINS[:first]):
        with ExitStack() as held:
            try:
                path = Path(tempfile.gettempdir(), f"avatar-tests-domain-{number}.lock")
                lock = held.enter_context(path.open("w"))
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except (BlockingIOError, PermissionError):  # PermissionError: another user's
                continue
            yield number
            return
    raise AssertionError("no DDS domain is free")


@pytest.fixture(scope="session", autouse=True)
def own_domain() -> Iterator[dict[str, str]]:
    """Isolate these tests from other cells on this machine or network.

    A measured cell uses this domain too, not a random one.
    """
    from avatar_ros.bench import cell

    with free_domain() as number, pytest.MonkeyPatch.context() as patch:
        patch.setattr(cell, "_DOMAINS", range(number, number + 1))
        environment = cell.isolated_environment()
        os.environ.update(environment)
        yield environment


@pytest.fixture(scope="session")
def organ() -> Any:
    """Build a coarse phantom's vademecum, for tests that need no accuracy."""
    return _organ()


@cached_on_disk
def _organ() -> Any:
    from avatar_core.geometry.phantom import phantom_liver
    from avatar_core.offline.rule import BuildRule
    from avatar_core.pipeline import OrganOptions, build

    rule = BuildRule(max_modes=30)
    return build(
        phantom_liver(12e-3), OrganOptions(n_displayed=0, n_vertices=800, rule=rule, n_certified=10)
    )


@pytest.fixture(scope="session")
def library(organ: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fill a library: good and bad files, the same organ by another name, and a link out."""
    from avatar_core.vademecum.storage import save_vademecum

    folder = tmp_path_factory.mktemp("library")
    outside = tmp_path_factory.mktemp("outside")
    save_vademecum(organ, folder / "liver.h5")
    save_vademecum(replace(organ, name="twin"), folder / "twin.h5")
    content = (folder / "liver.h5").read_bytes()
    (outside / "liver.h5").write_bytes(content)
    (folder / "link.h5").symlink_to(outside / "liver.h5")
    (folder / "short.h5").write_bytes(content[: len(content) // 2])
    middle = len(content) // 2
    flipped = bytes([content[middle] ^ 0x10])
    (folder / "flipped.h5").write_bytes(content[:middle] + flipped + content[middle + 1 :])
    (folder / "text.h5").write_text("not an HDF5 file")
    (folder / "folder.h5").mkdir()
    return folder


N_ATLAS = 3  # number of anatomies


@pytest.fixture(scope="session")
def livers() -> list[Any]:
    """Return the surfaces of the atlas, and one more."""
    return _livers()


def _livers() -> list[Any]:
    from avatar_core.geometry.phantom import phantom_liver, population

    coarse = phantom_liver(12e-3)
    maps = population(N_ATLAS + 1, seed=3, bend=0.01)
    return [replace(shape.moved(coarse), name=f"liver{i}") for i, shape in enumerate(maps)]


@cached_on_disk
def _patients() -> dict[str, bytes]:
    """Return the livers as files, and an atlas of all but the last, without need of accuracy."""
    from avatar_core.atlas.growth import AtlasOptions, SurfaceFile, create_atlas
    from avatar_core.atlas.response import ResponseSolver
    from avatar_core.atlas.workers import Workers
    from avatar_core.geometry.mesh import regions_by_rule, tetrahedralize
    from avatar_core.geometry.phantom import phantom_liver
    from avatar_core.shapes.registration import Template, TemplateRule

    rough = TemplateRule(
        n_stages=5, last_sweeps=0, n_samples=800, largest_mean=2e-3, largest_reverse_mean=5e-3
    )
    mesh = tetrahedralize(phantom_liver(12e-3), 300)
    with TemporaryDirectory() as name:
        files = []
        for liver in _livers():
            lines = [f"v {x} {y} {z}" for x, y, z in liver.vertices * 1e3]
            lines += [f"f {a} {b} {c}" for a, b, c in liver.faces + 1]
            files.append(Path(name, f"{liver.name}.obj"))
            files[-1].write_text("\n".join(lines) + "\n")
        growth = create_atlas(
            Path(name, "atlas"),
            [SurfaceFile(path) for path in files[:N_ATLAS]],
            AtlasOptions(spacing=0.02, rule=rough),
            template=Template("phantom", mesh, regions_by_rule(mesh)),
            workers=Workers(jobs=1),
            solve_response=ResponseSolver(rank=30),
        )
        assert len(growth.added) == N_ATLAS
        stored = [*files, *Path(name, "atlas").rglob("*.h5")]
        return {str(path.relative_to(name)): path.read_bytes() for path in stored}


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fill a library with surfaces, good and bad, and an atlas of all but the last one."""
    from avatar_core.common.hdf5 import replace_file

    folder = tmp_path_factory.mktemp("patients")
    outside = tmp_path_factory.mktemp("elsewhere") / "liver.obj"
    for name, content in _patients().items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    outside.write_bytes((folder / "liver0.obj").read_bytes())
    (folder / "link.obj").symlink_to(outside)
    (folder / "text.obj").write_text("not a surface")
    replace_file(folder / "foreign.h5", {}, {"format": "something else"})
    (folder / "large.obj").write_bytes(b"#" * 1_100_000)
    return folder


@pytest.fixture
def probe(own_domain: dict[str, str]) -> Iterator[Probe]:
    probe = Probe()
    yield probe
    probe.close()


@pytest.fixture(scope="module")
def lasting_probe(own_domain: dict[str, str]) -> Iterator[Probe]:
    """Make a probe for many short questions: a new node takes a second or more to find others."""
    probe = Probe()
    yield probe
    probe.close()


@pytest.fixture(scope="module")
def cell(own_domain: dict[str, str], library: Path) -> Iterator[dict[str, Any]]:
    """Start loader and contact node as a user does, for one module of tests."""
    from avatar_ros.bench.cell import Module

    files = ["-p", f"library_dir:={library}", "-p", "vademecum:=liver.h5"]
    processes = {
        "vademecum_loader": Module("vademecum_loader", ["--ros-args", *files], own_domain),
        "contact": Module("contact", PATIENT, own_domain),
    }
    yield processes
    codes = {name: process.finish() for name, process in processes.items()}
    assert codes == {"vademecum_loader": 0, "contact": 0}


@pytest.fixture(scope="session")
def touch(organ: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return a tip 4 mm deep in the middle of the accessible surface, and the outward normal."""
    from avatar_core.contact.tool_path import middle_of_access

    j = middle_of_access(organ)
    normal = organ.surface.normals[j]
    return organ.surface.centers[j] + (TIP_RADIUS - TOUCH_DEPTH) * normal, normal


@pytest.fixture
def bench(organ: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Make contact loops that the test steps, see ``SteppedLoop``."""
    from tests.ros.helpers.stepped_loop import stepped_loops

    with stepped_loops(organ, monkeypatch) as make:
        yield make
