"""What ``slam-observer`` can do: one module a command, each with ``add_parser``."""
