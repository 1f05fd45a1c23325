"""What YAML forbids and PyYAML takes: a key that is there twice, of which only the last counts."""

from __future__ import annotations

from collections import Counter

import yaml


def check_keys(node: yaml.MappingNode) -> None:
    """Check that a mapping has each key once, before it is made into a dict.

    Raises
    ------
    yaml.YAMLError
        If it has one twice.

    """
    keys = (key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
    for key, count in Counter(keys).items():
        if count > 1:
            raise yaml.YAMLError(f"'{key}' is there {count} times in one entry")
