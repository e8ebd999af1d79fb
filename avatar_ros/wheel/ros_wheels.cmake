# Included right after project(): by CMakeLists.txt for pip, and by colcon where the wheels are its
# underlay (tests/ros/helpers/colcon_build.sh). With an installation by apt nothing reads it.
#
# Makes the ROS 2 wheels of PyPI (ros-jazzy-*) usable as a build underlay:
# they live in the Python prefix, and that prefix is not an ament workspace.

find_package(Python3 REQUIRED COMPONENTS Interpreter)

# 1. The prefix the wheels' CMake packages are in.
execute_process(
  COMMAND "${Python3_EXECUTABLE}" -c
    "import importlib.util as u, pathlib as p; print(p.Path(u.find_spec('rosidl_cmake').origin).parents[4])"
  OUTPUT_VARIABLE _ros_prefix OUTPUT_STRIP_TRAILING_WHITESPACE COMMAND_ERROR_IS_FATAL ANY)
message(STATUS "ROS 2 wheels in ${_ros_prefix}")
list(PREPEND CMAKE_PREFIX_PATH "${_ros_prefix}")
set(ENV{AMENT_PREFIX_PATH} "${_ros_prefix}")

# 2. The exported *__rosidl_generator_py targets name include directories of
#    the machine the wheels were built on; drop what is not here.
function(_ros_wheels_drop_missing_include_dirs)
  get_property(_targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(_target IN LISTS _targets)
    get_target_property(_dirs ${_target} INTERFACE_INCLUDE_DIRECTORIES)
    if(_dirs)
      set(_kept "")
      foreach(_dir IN LISTS _dirs)
        if(NOT IS_ABSOLUTE "${_dir}" OR EXISTS "${_dir}")
          list(APPEND _kept "${_dir}")
        endif()
      endforeach()
      set_target_properties(${_target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${_kept}")
    endif()
  endforeach()
endfunction()
cmake_language(DEFER CALL _ros_wheels_drop_missing_include_dirs)

# 3. Python modules go to the wheel's platlib, the rest (lib/, share/)
#    below the environment's prefix.
if(SKBUILD_PLATLIB_DIR)
  file(RELATIVE_PATH PYTHON_INSTALL_DIR "${CMAKE_INSTALL_PREFIX}" "${SKBUILD_PLATLIB_DIR}")
  set(PYTHON_INSTALL_DIR "${PYTHON_INSTALL_DIR}" CACHE INTERNAL "")
endif()
