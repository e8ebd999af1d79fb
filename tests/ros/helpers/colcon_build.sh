#!/usr/bin/env bash
# Builds the package with colcon, as on a robot, but on the ROS 2 wheels of PyPI as underlay, and
# runs what it built; the project is not installed by pip.
#
#   tests/ros/helpers/colcon_build.sh FOLDER         an empty folder for a venv and a workspace, 3 GB
#   tests/ros/helpers/colcon_build.sh FOLDER VENV    with the wheels of a venv that has avatar
#
# Ends with 77 where PyPI cannot be reached, and says so.
set -euo pipefail
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH \
  LD_LIBRARY_PATH PYTHONPATH SKBUILD VIRTUAL_ENV FASTRTPS_DEFAULT_PROFILES_FILE

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../../.." && pwd)
folder=$(mkdir -p "$1" && cd "$1" && pwd)
venv=$folder/venv

# 1. A Python with the wheels and all that avatar_core needs, but without avatar.
if [ $# -gt 1 ]; then
  cp -al "$2" "$venv" 2>/dev/null || cp -a "$2" "$venv"
  find "$venv" \( -name 'avatar*' -o -name 'libavatar*' \) -prune -exec rm -rf {} +
else
  python3 -m venv "$venv"
fi
"$venv/bin/python" "$root/tests/ros/helpers/colcon_requirements.py" "$root/pyproject.toml" \
  >"$folder/requirements.txt" 2>"$folder/pip.log" ||
  { "$venv/bin/python" -m pip install -q tomli >"$folder/pip.log" 2>&1 &&
    "$venv/bin/python" "$root/tests/ros/helpers/colcon_requirements.py" "$root/pyproject.toml" \
      >"$folder/requirements.txt"; } || { cat "$folder/pip.log" >&2; exit 77; }
"$venv/bin/python" -m pip install -q -r "$folder/requirements.txt" >"$folder/pip.log" 2>&1 ||
  { tail -3 "$folder/pip.log" >&2; exit 77; }
if "$venv/bin/python" -m pip show avatar >/dev/null 2>&1; then echo "avatar is installed by pip" >&2; exit 1; fi

# 2. A workspace with the whole repository in it.
mkdir -p "$folder/workspace/src/avatar"
cp -r "$root"/{avatar_core,avatar_ros,params,pyproject.toml} "$folder/workspace/src/avatar/"
cd "$folder/workspace"
export PATH="$venv/bin:$PATH"

# 3. The wheels are no ament workspace: avatar_ros/cmake/ros_wheels.cmake makes them an underlay.
#    On an installation by apt, `source /opt/ros/jazzy/setup.bash; colcon build` is all.
AMENT_PREFIX_PATH=$venv CMAKE_PREFIX_PATH=$venv colcon build \
  --event-handlers console_cohesion+ --executor sequential \
  --cmake-args -DCMAKE_PROJECT_avatar_ros_INCLUDE=cmake/ros_wheels.cmake -DBUILD_TESTING=OFF \
  "-DPython3_EXECUTABLE=$venv/bin/python" >"$folder/colcon.log" 2>&1 ||
  { tail -30 "$folder/colcon.log" >&2; exit 1; }

# 4. What was built, with its setup file sourced, in a cell of its own.
export AMENT_PREFIX_PATH=$venv
set +u
# shellcheck disable=SC1091
source install/setup.bash
set -u
exec python "$root/tests/ros/helpers/colcon_run.py" "$folder/workspace/install/avatar_ros"
