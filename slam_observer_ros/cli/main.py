"""The ``slam-observer`` command: the observer on simulations and recordings, without ROS."""
# PYTHON_ARGCOMPLETE_OK (argcomplete looks for these words where it completes all programs)

from __future__ import annotations

from slam_observer_ros.common.process import leaving_at_once, SIGNALLED, stopping_once

with leaving_at_once():
    import argparse
    from collections.abc import Sequence
    from importlib import import_module
    import io
    import logging
    import os
    from pathlib import Path
    import signal
    import sys
    from typing import Any, NoReturn

    from slam_observer_ros.cli.console import MessageHandler, PROGRAM, show_message
    from slam_observer_ros.common import __version__
    from slam_observer_ros.common.errors import (
        IncompleteError,
        LossError,
        message_of,
        SlamObserverError,
    )
    from slam_observer_ros.common.process import use_one_thread
    from slam_observer_ros.settings.parameter_table import suggestion

EXIT_ERROR = 2
EXIT_LOSS = 3
EXIT_INCOMPLETE = 4

EXIT_OF: dict[type[Exception], int] = {LossError: EXIT_LOSS, IncompleteError: EXIT_INCOMPLETE}

COMMANDS = {
    'simulate': "run the paper's simulation",
    'convert': 'make a recording of a public data set, or a TUM file of poses',
    'map': 'make a map file of a map of another program, or check one',
    'replay': 'run a recording through the observer',
    'calibrate': 'find how sensor and odometry err, or their noise alone',
    'config': 'show parameter files, and what can be in them',
    'doctor': 'say what is installed, and what a node would hear',
    'batch': 'run many recordings with many settings',
}
"""What each command does; its module has its name, and only the one that is given is imported."""

OPTIONAL_PACKAGES = ('rosbags', 'mcap', 'matplotlib', 'rich', 'argcomplete')
"""What the extra ``cli`` of setup.py installs: a robot that only runs a node does without."""

EXAMPLES = """\
examples:
  slam-observer simulate --plot figures
      the paper's simulation, and its figures 3 and 4
  slam-observer convert mrclam MRCLAM_Dataset6 --robot 1 robot1.mcap
      a public data set as a recording
  slam-observer map convert tags.csv tags.yaml
      a table of surveyed landmarks as a map file
  slam-observer replay robot1.mcap --report robot1.html --tum robot1.tum
      a recording through the observer, and its accuracy
  slam-observer replay my_robot.mcap --config my_robot.yaml --json
      your own recording, with the parameter file of your observer_node
"""


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, and that guesses no option from its start."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(allow_abbrev=False, **settings)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse what is not known here, where the command whose help says more is known."""
        namespace, unknown = super().parse_known_args(args, namespace)
        if unknown:
            # By their names: dashes alone make any two options alike.
            options = [option.lstrip('-') for option in self._option_string_actions]
            meant = suggestion(unknown[0].partition('=')[0].lstrip('-'), options)
            meant = meant.replace("'", "'--", 1)
            self.error(f'unrecognized arguments: {" ".join(unknown)}{meant}')
        return namespace, unknown

    def error(self, message: str) -> NoReturn:
        """Show what is wrong and where help is, and exit."""
        show_message('error', f"{message}; see '{self.prog} --help'")
        sys.exit(EXIT_ERROR)


def make_parser(arguments: Sequence[str]) -> Parser:
    """Return the parser of the command line, with the options of the command that is given."""
    parser = Parser(
        prog=PROGRAM,
        description='The SLAM observer of Mahony and Hamel on simulations and recordings.',
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('--version', action='version', version=f'{PROGRAM} {__version__}')
    commands = parser.add_subparsers(dest='command', required=True, metavar='COMMAND')
    given = next((word for word in arguments if not word.startswith('-')), None)
    for name, help_text in COMMANDS.items():
        command = commands.add_parser(name, help=help_text)
        if name == given:
            with leaving_at_once():
                import_module(f'slam_observer_ros.cli.{name}').add_options(command)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    stop = stopping_once()
    if sys.stdout is None:  # a shell has closed it
        sys.stdout = Path(os.devnull).open('w', encoding='utf-8')  # noqa: SIM115 (till the end)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors='replace')  # a terminal without ± is no reason to end
    try:
        logging.getLogger('slam_observer_ros').handlers = [MessageHandler(logging.WARNING)]
        words = sys.argv[1:] if arguments is None else arguments
        if '_ARGCOMPLETE' in os.environ:  # a shell wants a word completed
            import argcomplete  # which --help has no use for

            typed = os.environ.get('COMP_LINE', '').split()[1:]
            argcomplete.autocomplete(make_parser(typed))  # and ends
        use_one_thread()
        with leaving_at_once():
            args = make_parser(words).parse_args(words)
        # Unlike its default, this lets unfinished files be cleared away.
        signal.signal(signal.SIGTERM, stop)
        args.run(args)
        sys.stdout.flush()
    except (SlamObserverError, OSError) as error:
        if isinstance(error, BrokenPipeError):
            # Whoever read the output has gone: the interpreter flushes to nowhere at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return SIGNALLED + signal.SIGPIPE
        show_message('error', message_of(error))
        return EXIT_OF.get(type(error), EXIT_ERROR)
    except ModuleNotFoundError as error:
        package = (error.name or '').partition('.')[0]
        if package not in OPTIONAL_PACKAGES:
            raise
        needed = f"'pip install {' '.join(OPTIONAL_PACKAGES)}' brings what is used"
        show_message('error', f'{package} is not installed: {needed}')
        return EXIT_ERROR
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the interpreter would end by another one
        return SIGNALLED + signal.SIGINT
    except RuntimeError:  # as Python before 3.12 makes of any exception while a class is defined
        if stop.number is None:
            raise
        return SIGNALLED + stop.number
    return 0


if __name__ == '__main__':
    sys.exit(main())
