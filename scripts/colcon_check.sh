#!/usr/bin/env bash
# Usage: colcon_check.sh VENV
# Builds, installs and tests the package with colcon, as a ROS workspace would, in a temporary
# folder. colcon runs the tests of what is installed; `make pytest` runs all of them.
set -euo pipefail
colcon=$1/bin/colcon
workspace=$(mktemp -d)
trap 'rm -rf "$workspace"' EXIT
bases=(--base-paths . --build-base "$workspace/build" --install-base "$workspace/install")

"$colcon" --log-base "$workspace/log" build "${bases[@]}"
for executable in slam-observer observer_node simulator_node; do
    test -x "$workspace/install/slam_observer_ros/lib/slam_observer_ros/$executable"
done
"$colcon" --log-base "$workspace/log" test "${bases[@]}" --return-code-on-test-failure \
    --event-handlers console_direct+ --pytest-args test/project/test_package.py
