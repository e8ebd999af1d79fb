"""Prints what a colcon workspace needs from PyPI: dependencies, ROS wheels, generators, colcon.

python tests/ros/helpers/colcon_requirements.py pyproject.toml
"""

from __future__ import annotations

import sys
from pathlib import Path

try:
    import tomllib
except ImportError:  # Python 3.10
    import tomli as tomllib  # type: ignore[no-redef]

COLCON = (
    "colcon-core",
    "colcon-cmake",
    "colcon-ros",
    "colcon-bash",
    "colcon-output",
    "colcon-package-selection",
    "colcon-test-result",
    "cmake",
    "pytest",
)


def requirements(path: Path) -> list[str]:
    """Return one requirement per line."""
    project = tomllib.loads(path.read_text())
    (wheels,) = project["tool"]["dynamic-metadata"]
    return [
        *project["project"]["dependencies"],
        *wheels["dependencies"],
        *project["tool"]["scikit-build"]["build"]["requires"],
        *COLCON,
    ]


if __name__ == "__main__":
    print("\n".join(requirements(Path(sys.argv[1]))))
