#!/usr/bin/env bash
# Usage: setup_venv.sh VENV
# Makes the virtual environment in which everything runs: with ROS 2 sourced it sits on top of that
# ROS; otherwise the ROS wheels from PyPI stand in, and tf2_msgs, which has none, is built. The
# wheels are those of Jazzy, and of Kilted with ROS_WHEELS=kilted.
set -euo pipefail
venv=$1

usable() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null
}

for python in "${PYTHON:-python3}" python3.12 python3.13 python3.14 python3.11 python3.10 none; do
    usable "$python" && break
done
if [ "$python" = none ]; then
    echo "Python 3.10 or later is needed; name one with PYTHON=/path/to/python3.12" >&2
    exit 1
fi

export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_WARN_SCRIPT_LOCATION=1
echo "setting up $venv with $("$python" --version) ..."
if [ "${ROS_DISTRO:-}" = humble ]; then
    echo "the nodes need rclpy of Jazzy or later: source that, or use a shell without ROS" >&2
    exit 1
elif [ -n "${ROS_DISTRO:-}" ]; then
    "$python" -m venv --clear --system-site-packages "$venv"
    # Messages are compiled against the numpy of the distribution: no other may take its place.
    numpy=$("$venv/bin/python" -c 'import numpy; print(numpy.__version__)')
    "$venv/bin/python" -m pip install --quiet --editable '.[cli,test,dev]' "numpy==$numpy"
elif [ "${ROS_WHEELS:-jazzy}" = jazzy ]; then
    "$python" -m venv --clear "$venv"
    # All that is needed, and nothing that is not what it was when `make lock` was run.
    "$venv/bin/python" -m pip install --quiet --no-deps --require-hashes --requirement requirements.lock
    "$venv/bin/python" -m pip install --quiet --no-deps --no-build-isolation --editable .
    "$venv/bin/python" scripts/build_tf2_msgs.py
else
    "$python" -m venv --clear "$venv"
    # The same versions, but for those of ROS itself.
    "$venv/bin/python" -m pip install --quiet --constraint <(grep -v '^ros-' constraints.txt) \
        --editable ".[cli,test,dev,ros-$ROS_WHEELS]"
    "$venv/bin/python" scripts/build_tf2_msgs.py
fi
