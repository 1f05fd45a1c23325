"""Parameters that ROS gives to a node: former names."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from slam_observer_ros.common.errors import ParameterError
from slam_observer_ros.nodes.ros_parameters import declare_settings
from slam_observer_ros.settings import parameter_table
from slam_observer_ros.settings.estimator_settings import Settings


def test_a_former_name_is_refused_with_the_new_one(monkeypatch):
    monkeypatch.setitem(parameter_table.RENAMED, 'gain_design', 'gains')
    node = SimpleNamespace(
        _parameter_overrides={'gain_design': 'constant'}, has_parameter=lambda _name: False
    )
    with pytest.raises(ParameterError, match=r"^'gain_design' is now 'gains'$"):
        declare_settings(node, Settings)
