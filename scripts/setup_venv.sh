#!/usr/bin/env bash
# Usage: setup_venv.sh VENV
# Makes the virtual environment in which everything runs: with ROS 2 Jazzy sourced it sits on top
# of that ROS; otherwise the ROS wheels from PyPI stand in, and tf2_msgs, which has none, is built.
set -euo pipefail
venv=$1

usable() {
    "$1" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 14))' 2>/dev/null
}

for python in "${PYTHON:-python3}" python3.12 python3.13 python3.11 python3.10 none; do
    usable "$python" && break
done
if [ "$python" = none ]; then
    echo "Python 3.10 to 3.13 is needed; name one with PYTHON=/path/to/python3.12" >&2
    exit 1
fi

export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_WARN_SCRIPT_LOCATION=1
echo "setting up $venv with $("$python" --version) ..."
if [ "${ROS_DISTRO:-}" = jazzy ]; then
    "$python" -m venv --clear --system-site-packages "$venv"
    # Jazzy's messages are compiled against numpy 1.
    "$venv/bin/python" -m pip install --quiet --editable '.[test,dev]' 'numpy<2'
elif [ -z "${ROS_DISTRO:-}" ]; then
    "$python" -m venv --clear "$venv"
    # All that is needed, and nothing that is not what it was when `make lock` was run.
    "$venv/bin/python" -m pip install --quiet --no-deps --require-hashes --requirement requirements.lock
    "$venv/bin/python" -m pip install --quiet --no-deps --no-build-isolation --editable .
    "$venv/bin/python" scripts/build_tf2_msgs.py
else
    echo "ROS 2 $ROS_DISTRO is sourced, Jazzy is needed: source that, or use a shell without ROS" >&2
    exit 1
fi
