"""States of the planning page that a user keeps: poses, scene, material and view, with a note.

They lie in a file of the library, ``plan-ID.json`` for each vademecum, by its id: a state is worth
nothing on another organ.
"""

from __future__ import annotations

import base64
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from avatar_core.common.files import replaced
from avatar_core.errors import StorageError
from avatar_ros.ui.orientation import AXES
from avatar_ros.ui.view import LOOKS

_ID = 16  # letters of the vademecum's id in the name of the file
_MOST_BYTES = 64 << 20
_VERSION = 2  # in the first, a state had one tool, ``target``


@dataclass(frozen=True)
class Bookmark:
    """A kept state.

    note : of the user; made : local time, ISO 8601
    targets : of each tool's tip [m]; scene : its name, empty for natural effects
    material : values by coordinate [SI]
    camera : position, what is looked at, what is up, nine numbers [m]; empty without a browser
    look : whole, glass or cut open; side, part : of the cut
    lines : numbers as shown then, after what must not be missed
    picture : PNG, base64; empty if the browser gave none
    """

    note: str
    made: str
    targets: tuple[tuple[float, float, float], ...]
    scene: str
    material: dict[str, float]
    camera: tuple[float, ...]
    look: tuple[str, str, float]
    lines: tuple[str, ...]
    picture: str = ""

    @property
    def label(self) -> str:
        """To choose it by."""
        return f"{self.made[5:19].replace('T', ' ')} {self.note}".strip()


class Bookmarks:
    """Those of one organ, oldest first."""

    def __init__(self, folder: Path, identity: str, name: str) -> None:
        self.path = folder / f"plan-{identity[:_ID]}.json"
        self._identity, self._name = identity, name
        self.kept: list[Bookmark] = _read(self.path, identity) if self.path.is_file() else []

    def keep(self, bookmark: Bookmark) -> None:
        """Add one, and write the file."""
        self.kept.append(bookmark)
        self._write()

    def drop(self, label: str) -> None:
        """Remove one, and write the file."""
        found = self.find(label)
        if found is not None:
            self.kept.remove(found)
            self._write()

    def find(self, label: str) -> Bookmark | None:
        """The newest of a label."""
        return next((b for b in reversed(self.kept) if b.label == label), None)

    def _write(self) -> None:
        whole = {
            "version": _VERSION,
            "vademecum_id": self._identity,
            "vademecum": self._name,
            "states": [asdict(bookmark) for bookmark in self.kept],
        }
        with replaced(self.path) as file:
            file.write_text(json.dumps(whole, indent=1))


def _read(path: Path, identity: str) -> list[Bookmark]:
    """Those of a file, each checked, since anybody may have written it.

    Raises
    ------
    StorageError
        For a file that is none, or is of another vademecum.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"more than {_MOST_BYTES >> 20} MB")
        whole = json.loads(path.read_text())
        if whole["version"] not in (1, _VERSION) or whole["vademecum_id"] != identity:
            raise ValueError("of another version or vademecum")
        return [_checked(state) for state in whole["states"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StorageError(
            f"{path.name} holds no kept states of this organ ({error}); move it away"
        ) from error


def _checked(state: dict[str, Any]) -> Bookmark:
    look, side, part = state["look"]
    camera = _numbers(state["camera"])
    if len(camera) not in (0, 9):
        raise ValueError("a camera has nine numbers")
    if look not in LOOKS or side not in AXES or not 0.0 <= float(part) <= 1.0:
        raise ValueError("an organ is not shown so")
    targets = state["targets"] if "targets" in state else [state["target"]]
    picture = str(state.get("picture", ""))
    base64.b64decode(picture, validate=True)
    return Bookmark(
        note=str(state["note"]),
        made=str(state["made"]),
        targets=tuple(map(_place, targets)),
        scene=str(state["scene"]),
        material={str(key): _numbers([value])[0] for key, value in state["material"].items()},
        camera=camera,
        look=(str(look), str(side), _numbers([part])[0]),
        lines=tuple(str(line) for line in state["lines"]),
        picture=picture,
    )


def _place(values: Any) -> tuple[float, float, float]:
    x, y, z = _numbers(values)
    return x, y, z


def _numbers(values: Any) -> tuple[float, ...]:
    found = tuple(float(value) for value in values)
    if not all(map(math.isfinite, found)):
        raise ValueError("a number is not finite")
    return found
