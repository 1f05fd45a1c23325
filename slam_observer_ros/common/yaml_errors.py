"""What is wrong with a YAML file: as PyYAML says it, and keys given twice, which it lets pass."""

from __future__ import annotations

from collections import Counter
from typing import Any

import yaml


def reason_of(error: Exception) -> str:
    """Return in one line why YAML could not be read, and where."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem and error.problem_mark:
        return f'{error.problem} in line {error.problem_mark.line + 1}'
    return str(error).splitlines()[0]


class UniqueKeys:
    """Mixin: a YAML loader with it before PyYAML's own refuses a key that is there twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> Any:
        """Return a mapping; raise a YAMLError if it has a key twice."""
        keys = [key for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        counts = Counter(key.value for key in keys)
        for key in keys:
            if counts[key.value] > 1:
                problem = f"'{key.value}' is there {counts[key.value]} times in one entry"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
        return super().construct_mapping(node, deep)  # type: ignore[misc]  # the loader's
