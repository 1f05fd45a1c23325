"""The benchmark of cost, by which docs/performance.md is written: ``make benchmark``.

Each part measures ratios within one run, and can be measured alone; the page has the latest
figures of each. ``accuracy.py`` compares how well the estimators do instead.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from datetime import date
import json
import logging
import os
from pathlib import Path
import platform
import sys
import time

from cost_tables import Tables
from node_costs import measure_node
import performance_page
from performance_page import Measured, Part
from program_costs import measure_memory, measure_replay, measure_start
from step_costs import measure_large, measure_steps
from threadpoolctl import threadpool_limits
from world_costs import measure_passing, measure_worlds
import worlds

PARTS: dict[str, Callable[[], Tables]] = {
    'start': measure_start,
    'node': measure_node,
    'replay': measure_replay,
    'memory': measure_memory,
    'steps': measure_steps,
    'large': measure_large,
    'worlds': measure_worlds,
    'passing': measure_passing,
}
"""What is measured; each part takes a few minutes at most."""

NEED_DATA = ('replay',)


def main() -> None:
    """Measure what was asked for, print it, and write it down if that was asked for, too."""
    args = parse_arguments()
    logging.basicConfig(format='benchmark: %(message)s', level=logging.INFO)
    logging.getLogger('slam_observer_ros').setLevel(logging.ERROR)
    threadpool_limits(1)  # as the nodes do
    measured: performance_page.Figures = {}
    for name in args.parts or PARTS:
        if name in NEED_DATA and not worlds.data_folder().is_dir():
            logging.warning('%s is left out: no recordings in %s', name, worlds.data_folder())
            continue
        start_s = time.monotonic()
        part = Part(measured=this_machine(), tables=PARTS[name]())
        logging.info('%s took %.0f s', name, time.monotonic() - start_s)
        sys.stdout.write(performance_page.part_text(part))
        measured[name] = part
    if args.write_docs:
        figures = performance_page.read_figures() | measured
        performance_page.FIGURES.write_text(json.dumps(figures, indent=1) + '\n')
        performance_page.write(figures)


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        'parts', nargs='*', metavar='PART', help=f'only these: {" ".join(PARTS)}; default all'
    )
    parser.add_argument(
        '--write-docs',
        action='store_true',
        help='keep the figures, and rewrite the tables of docs/performance.md and its picture',
    )
    args = parser.parse_args()
    if unknown := [name for name in args.parts if name not in PARTS]:
        parser.error(f'no part is named {" ".join(unknown)}; there are {" ".join(PARTS)}')
    return args


def this_machine() -> Measured:
    """Return when and where something is measured now."""
    models = [
        line.partition(':')[2].strip()
        for line in Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
        if line.startswith('model name')
    ]
    return Measured(
        date=date.today().isoformat(),
        processor=models[0] if models else platform.machine(),
        cores=os.cpu_count() or 1,
        load=round(os.getloadavg()[0], 1),
    )


if __name__ == '__main__':
    main()
