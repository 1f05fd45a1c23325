"""The sample policy for secured graphs names what the node uses, and nothing else."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from node_processes import running
import pytest
from robots import Robot

pytestmark = pytest.mark.ros

POLICY = Path(__file__).parents[2] / 'config' / 'sros2_policy.xml'
NODE = 'observer_node'

NOT_ALWAYS_USED = {
    *(('subscribe', f'/{name}') for name in ('imu', 'clock', 'parameter_events')),
    *(('reply', f'/{NODE}/{name}') for name in ('load_map_from', 'save_map_to')),
}
"""Those of ``use_imu``, ``use_sim_time`` and nav2_msgs, and one of some releases of rclpy."""


def allowed():
    """What the policy allows, as pairs of how and a full name."""
    profile = ElementTree.parse(POLICY).find('enclaves/enclave/profiles/profile')
    assert profile.attrib == {'ns': '/', 'node': NODE}
    return {
        (how, '/' + entry.text.replace('~', NODE))
        for entries in profile
        for how, word in entries.attrib.items()
        if word == 'ALLOW'
        for entry in entries
    }


def test_the_policy_allows_what_the_node_uses(ros, tmp_path):
    expected = allowed() - NOT_ALWAYS_USED
    with running(NODE, tmp_path / 'log'), Robot(ros):
        # They become known one by one.
        ros.spin_until(lambda: expected <= used_by_node(ros.node), 'all that the policy allows')
        assert used_by_node(ros.node) - NOT_ALWAYS_USED == expected


def used_by_node(observed_by):
    """What the node uses, as far as another node has heard of it by now."""
    return {
        (how, name)
        for how, names_and_types in (
            ('subscribe', observed_by.get_subscriber_names_and_types_by_node),
            ('publish', observed_by.get_publisher_names_and_types_by_node),
            ('reply', observed_by.get_service_names_and_types_by_node),
        )
        for name, _ in names_and_types(NODE, '/')
    }
