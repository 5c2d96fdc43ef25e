#!/bin/bash
# Install ROS 2 (rclpy with Fast DDS) in an empty environment, build tipforce_msgs there, and let it read `tipforce ros2`.
# Usage: tests/ros2.sh [PYTEST ARGUMENTS]; needs cmake, g++ and Python.h, and a PYTHON of 3.11 to 3.13 (default: python3)
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
ros=$folder/ros
"$python" -m venv "$ros"
# The wheels do not name all that a build of messages needs.
build=(ament-cmake ament-cmake-include-directories ament-cmake-pytest ament-cmake-ros-core ament-package
    fastrtps-cmake-module python-cmake-module rosidl-core-generators rosidl-default-generators)
"$ros/bin/pip" install --quiet --disable-pip-version-check ros-rclpy ros-rmw-fastrtps-cpp ros-geometry-msgs \
    ros-diagnostic-msgs catkin_pkg "${build[@]/#/ros-}"
# Their CMake files name the Python of the machine that built them.
include=$("$ros/bin/python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
packages=$("$ros/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
grep -rl /opt/python/ "$ros/share" | xargs sed -i \
    -e "s#/opt/python/[^/]*/include/python[0-9.]*#$include#g; s#/opt/python/[^/]*/lib/python[0-9.]*/site-packages#$packages#g"
export AMENT_PREFIX_PATH=$ros PATH="$ros/bin:$PATH"
cmake -S docs/examples/ros2/tipforce_msgs -B "$folder/build" --log-level=ERROR -DBUILD_TESTING=OFF \
    -DCMAKE_PREFIX_PATH="$ros" -DCMAKE_INSTALL_PREFIX="$ros" -DPython3_EXECUTABLE="$ros/bin/python" >"$folder/log" &&
    cmake --build "$folder/build" --target install -j2 >>"$folder/log" || { tail -n 30 "$folder/log" >&2; exit 1; }
TIPFORCE_ROS_PYTHON=$ros/bin/python .venv/bin/python -m pytest tests/tools/ros2/rclpy_checks.py "$@"
