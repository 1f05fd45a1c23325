#!/usr/bin/env bash
# Usage: setup_venv.sh VENV [develop]
# Makes the virtual environment in which everything runs: with ROS 2 sourced it sits on top of that
# ROS; otherwise the ROS wheels from PyPI stand in, and tf2_msgs, which has none, is built. The
# wheels are those of Jazzy, and of Kilted with ROS_WHEELS=kilted. With `develop`, what lint and
# tests need is added to one that is there.
set -euo pipefail
venv=$1
purpose=${2:-run}

usable() {
    "$1" -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null
}

create() {  # with options of python -m venv
    for python in "${PYTHON:-python3}" python3.12 python3.13 python3.14 python3.11 python3.10 none; do
        usable "$python" && break
    done
    if [ "$python" = none ]; then
        echo "Python 3.10 or later is needed; name one with PYTHON=/path/to/python3.12" >&2
        exit 1
    fi
    echo "setting up $venv with $("$python" --version) ..."
    "$python" -m venv --clear "$@" "$venv"
}

install() {
    "$venv/bin/python" -m pip install --quiet "$compile" "$@"
}

export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_WARN_SCRIPT_LOCATION=1
if [ "${ROS_DISTRO:-}" = humble ]; then
    echo "the nodes need rclpy of Jazzy or later: source that, or use a shell without ROS" >&2
    exit 1
fi
if [ "$purpose" = develop ]; then
    echo "adding what lint and tests need to $venv ..."
    extras=cli,test,dev lock=requirements-develop.lock
    compile=--no-compile  # hardly anything of pandas and the like is imported
    create() { :; }
else
    extras=cli lock=requirements.lock compile=--compile
fi
if [ -n "${ROS_DISTRO:-}" ]; then
    create --system-site-packages
    # Messages are compiled against the numpy of the distribution: no other may take its place.
    numpy=$("$venv/bin/python" -c 'import numpy; print(numpy.__version__)')
    install --editable ".[$extras]" "numpy==$numpy"
    exit
fi
create
if [ "${ROS_WHEELS:-jazzy}" = jazzy ]; then
    # All that is needed, and nothing that is not what it was when `make lock` was run.
    install --no-deps --require-hashes --requirement "$lock"
    if [ "$purpose" = run ]; then
        install --no-deps --no-build-isolation --editable .
    fi
else
    # The same versions, but for those of ROS itself.
    install --constraint <(grep -v '^ros-' constraints.txt) --editable ".[$extras,ros-$ROS_WHEELS]"
fi
if [ "$purpose" = run ]; then
    "$venv/bin/python" scripts/build_tf2_msgs.py
fi
