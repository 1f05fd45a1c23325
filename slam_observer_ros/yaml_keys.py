"""What YAML forbids and PyYAML takes: a key that is there twice, of which only the last counts."""

from __future__ import annotations

from collections import Counter
from typing import Any

import yaml


class UniqueKeys:
    """Mixin: a YAML loader with it before PyYAML's own refuses a key that is there twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> Any:
        """Return a mapping; raise a YAMLError if it has a key twice."""
        keys = (key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        for key, count in Counter(keys).items():
            if count > 1:
                raise yaml.YAMLError(f"'{key}' is there {count} times in one entry")
        return super().construct_mapping(node, deep)  # type: ignore[misc]  # the loader's
