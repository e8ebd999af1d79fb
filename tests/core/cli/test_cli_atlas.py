"""Sources of an atlas, as the command line names them."""

from __future__ import annotations

from pathlib import Path

from avatar_core.atlas.growth import SurfaceFile
from avatar_core.cli.atlas import _sources


def test_a_label_is_that_of_label_maps_alone(tmp_path: Path) -> None:
    for name in ("a.obj", "b.nii.gz"):
        (tmp_path / name).touch()
    found = [one for one in _sources([str(tmp_path)], "mm", None, "1") if type(one) is SurfaceFile]
    assert [(one.path.name, one.label) for one in found] == [("a.obj", None), ("b.nii.gz", "1")]
