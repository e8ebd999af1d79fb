"""A replayed recording gives the same forces, or reports why it cannot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from avatar_core.contact.effects import Effect, Friction, Respiration, Viscoelasticity
from avatar_core.contact.layout import default_effects
from avatar_core.contact.model import FAR_AWAY
from avatar_core.contact.tool_path import push_and_slide
from avatar_core.errors import StorageError
from avatar_core.geometry.tip import Tip
from avatar_core.scene.file import write_scene
from avatar_core.scene.model import Scene
from avatar_core.scene.recording import Clouds, Periods, Recording, load_recording, save_recording
from avatar_core.scene.replay import replay
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import load_vademecum, save_vademecum
from tests.core.conftest import Command
from tests.helpers.contact import prepare, solve

RADIUS = 5e-3
SPHERE = Tip("sphere", RADIUS)
SAME = 1e-9  # promised tolerance [N]; the difference is 0 in fact
VISCOUS = Viscoelasticity(g=(0.3,), tau=(0.1,))


def stored(vademecum: Vademecum, folder: Path) -> Vademecum:
    save_vademecum(vademecum, folder / "liver.h5")
    return load_vademecum(folder / "liver.h5")


def recorded(vademecum: Vademecum, effects: Sequence[Effect], skipped: int = 0) -> Recording:
    """Record a push and a slide as a loop would, with failed poses; from a period on."""
    tips = push_and_slide(vademecum, RADIUS, 4e-3, 3e-3, 900, 40)[:, None].copy()
    tips[200:210] = np.nan
    tips[300:350] = FAR_AWAY
    tips = np.concatenate([np.full((20, 1, 3), FAR_AWAY), tips, np.full((5, 1, 3), FAR_AWAY)])
    turn = 1e-3 * np.clip(np.arange(len(tips)) - 500, 0, 100)
    orientation = Rotation.from_rotvec(turn[:, None] * [0.0, 1.0, 0.0]).as_quat()[:, None]
    data = prepare(vademecum, (SPHERE,), cloud="off", effects=effects)
    force, status = np.empty(tips.shape), np.empty((len(tips), 1), np.uint8)
    for k, tip in enumerate(tips):
        solve(data, tip, orientation[k])
        force[k], status[k] = data.out.force, data.out.status
    n = len(tips)
    periods = Periods(
        number=np.arange(n) + 100,
        stamp=np.arange(n) * 1_000_000,
        tip=tips,
        orientation=orientation,
        status=status,
        force=force,
        error=np.zeros((n, 1)),
        sent_fraction=np.ones((n, 1)),
    )
    kept = {name: value[skipped:] for name, value in vars(periods).items()}
    return Recording(
        vademecum.id,
        vademecum.name,
        write_scene(Scene(effects=tuple(effects))),
        1000.0,
        skipped == 0,
        Periods(**kept),
        Clouds(np.array([100, 133]), np.zeros((2, 7, 3), np.float32)),
    )


@pytest.fixture(scope="module")
def organ(straight: Vademecum, tmp_path_factory: pytest.TempPathFactory) -> Vademecum:
    return stored(straight, tmp_path_factory.mktemp("replay"))


@pytest.mark.parametrize(
    "effects",
    [
        pytest.param((), id="elastic"),
        pytest.param((Friction(),), id="friction", marks=pytest.mark.long),
        pytest.param((VISCOUS,), id="viscous"),
    ],
)
def test_the_forces_are_the_same(
    organ: Vademecum, effects: tuple[Effect, ...], tmp_path: Path
) -> None:
    made = recorded(organ, effects)
    save_recording(made, tmp_path / "push.h5")
    read = load_recording(tmp_path / "push.h5")
    found = replay(read, organ)
    assert np.linalg.norm(read.periods.force, axis=2).max() > 0.1
    assert found.known.all()
    assert found.difference(read) <= SAME
    for part in ("periods", "clouds"):
        for name, value in vars(getattr(made, part)).items():
            np.testing.assert_array_equal(getattr(getattr(read, part), name), value)


@pytest.mark.long
def test_large_pushes_too(bent: Vademecum, tmp_path: Path) -> None:
    organ = stored(bent, tmp_path)
    made = recorded(organ, default_effects(organ, (Tip(),)))
    assert replay(made, organ).difference(made) <= SAME


def test_a_start_in_contact_is_compared_from_the_first_free_period_on(organ: Vademecum) -> None:
    made = recorded(organ, (Friction(),), skipped=120)
    force = made.periods.force[:, 0]
    assert force[0].any()
    found = replay(made, organ)
    first = int(np.argmin(force.any(axis=1)))  # while poses fail, the tip may still be inside
    assert not found.known[: first + 1].any()
    assert found.known[-1] and found.difference(made) <= SAME


def test_after_lost_periods_what_relaxes_is_unknown(organ: Vademecum) -> None:
    elastic, viscous = recorded(organ, ()), recorded(organ, (VISCOUS,))
    for made, goes_on in ((elastic, True), (viscous, False)):
        kept = {k: np.delete(v, slice(430, 440), axis=0) for k, v in vars(made.periods).items()}
        with_gap = replace(made, periods=Periods(**kept))
        assert int(with_gap.periods.lost.sum()) == 10
        found = replay(with_gap, organ)
        assert found.known[:430].all() and not found.known[430]
        assert bool(found.known[-1]) == goes_on
        assert found.difference(with_gap) <= SAME


def test_the_command_says_how_far_forces_differ(
    avatar: Command, straight: Vademecum, tmp_path: Path
) -> None:
    organ = stored(straight, tmp_path)
    file, made = tmp_path / "push.h5", recorded(organ, ())
    given = ("replay", file, "--vademecum", tmp_path / "liver.h5")
    save_recording(made, file)
    code, out, _ = avatar(*given)
    assert code == 0 and "largest difference 0.00e+00 N" in out
    made.periods.force[500] += 1e-6
    save_recording(made, file)
    code, _, err = avatar(*given)
    assert code == 1 and "forces differ by 1.73e-06 N" in err
    save_recording(recorded(organ, (Respiration(),)), file)
    code, _, err = avatar(*given)
    assert code == 1 and "record without respiration" in err


def test_another_vademecum_is_refused(organ: Vademecum) -> None:
    other = replace(recorded(organ, ()), vademecum_id="0" * 64)
    with pytest.raises(StorageError, match="give the file it was made with"):
        replay(other, organ)


def test_a_scene_that_is_not_understood_is_refused(organ: Vademecum) -> None:
    other = replace(recorded(organ, ()), scene="tools: [{name: tool, tip_radius: 0.005}]")
    with pytest.raises(StorageError, match=r"tip_radius is unknown; record again, "):
        replay(other, organ)


def test_an_organ_that_hardly_moves_is_recorded(organ: Vademecum, tmp_path: Path) -> None:
    """Two minutes of zeros take their space, so that the claimed size is the file's."""
    still = Clouds(np.arange(900), np.zeros((900, 300, 3), np.float32))
    save_recording(replace(recorded(organ, ()), clouds=still), tmp_path / "still.h5")
    assert load_recording(tmp_path / "still.h5").clouds.displacement.shape == (900, 300, 3)


def test_a_spoilt_file_is_refused(organ: Vademecum, tmp_path: Path) -> None:
    file = tmp_path / "push.h5"
    save_recording(recorded(organ, ()), file)
    content = file.read_bytes()
    with h5py.File(file, "r+") as opened:
        opened["periods/force"][3] += 1.0
    with pytest.raises(StorageError, match="altered"):
        load_recording(file)
    file.write_bytes(content[: len(content) // 2])
    with pytest.raises(StorageError, match="truncated"):
        load_recording(file)
    file.write_bytes(content)
    with h5py.File(file, "r+") as opened:
        del opened["periods/force"]
        opened["periods/force"] = h5py.ExternalLink("/etc/passwd", "/x")
    with pytest.raises(StorageError, match=r"only a link.*record again"):
        load_recording(file)
    save_vademecum(organ, file)
    with pytest.raises(StorageError, match="no recording"):
        load_recording(file)
