"""States of the planning page that a user keeps: poses, scene, material and view, with a note.

They lie in a file of the library, ``plan-ID.json`` for each vademecum, by its id: a state cannot be
used on another organ.
"""

from __future__ import annotations

import base64
import json
import math
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path

from avatar_core.common.dataclass_json import of_plain
from avatar_core.common.files import replaced
from avatar_core.errors import StorageError
from avatar_ros.ui.view.legend import DISPLACEMENT, EXPECTED_ERROR, SPREAD
from avatar_ros.ui.view.orientation import AXES
from avatar_ros.ui.view.view import LOOKS

_ID = 16  # letters of the vademecum's id in the name of the file
_MOST_BYTES = 64 << 20
_VERSION = 2


@dataclass(frozen=True)
class Bookmark:
    """A kept state.

    note : note of the user; made : local time, ISO 8601
    targets : position of each tool's tip [m]; scene : its name, empty for natural effects
    material : values by coordinate [SI]
    camera : position, point looked at, up direction, nine numbers [m]; empty without a browser
    look : whole, glass or cut open; side, part : of the cut
    lines : alerts and numbers as shown then
    picture : PNG, base64; empty if the browser gave none
    scale : name of the picture's colour scale with its unit, and its end in that unit; None if
        it is not known
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
    scale: tuple[str, float] | None = None

    def __post_init__(self) -> None:
        look, side, part = self.look
        numbers = [*chain(*self.targets), *self.material.values(), *self.camera, part]
        if not all(map(math.isfinite, numbers)):
            raise ValueError("a number is not finite")
        if len(self.camera) not in (0, 9):
            raise ValueError("a camera has nine numbers")
        if look not in LOOKS or side not in AXES or not 0.0 <= part <= 1.0:
            raise ValueError("the look is unknown")
        if self.scale is not None:
            what, top = self.scale
            if what not in (DISPLACEMENT, EXPECTED_ERROR, SPREAD) or not 0.0 < top < math.inf:
                raise ValueError("the colour scale is unknown")
        base64.b64decode(self.picture, validate=True)

    @property
    def label(self) -> str:
        """Return the name in the list of kept states."""
        return f"{self.made[5:19].replace('T', ' ')} {self.note}".strip()


class Bookmarks:
    """Kept states of one organ, oldest first."""

    def __init__(self, folder: Path, identity: str, name: str) -> None:
        self.path = folder / f"plan-{identity[:_ID]}.json"
        self._identity, self._name = identity, name
        self.kept: list[Bookmark] = _read(self.path, identity) if self.path.is_file() else []

    def keep(self, bookmark: Bookmark) -> None:
        """Add a state, and write the file."""
        self.kept.append(bookmark)
        self._write()

    def drop(self, label: str) -> None:
        """Remove a state, and write the file."""
        found = self.find(label)
        if found is not None:
            self.kept.remove(found)
            self._write()

    def find(self, label: str) -> Bookmark | None:
        """Return the newest state of a label."""
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
    """Read the states of a file and check each, since anybody may have written it.

    Raises
    ------
    StorageError
        If the file is damaged, or belongs to another vademecum.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError(f"more than {_MOST_BYTES >> 20} MB")
        whole = json.loads(path.read_text())
        if whole["version"] != _VERSION or whole["vademecum_id"] != identity:
            raise ValueError("it was written for another version or vademecum")
        return [of_plain(Bookmark, state, "states") for state in whole["states"]]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, StorageError) as error:
        raise StorageError(
            f"{path.name} holds no kept states of this organ ({error}); move it away"
        ) from error
