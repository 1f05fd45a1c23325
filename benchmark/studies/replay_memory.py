"""How much memory a replay takes, against the length of the recording: it should not matter.

Recordings of so many Twists, and of one cloud of landmarks, are made in a temporary folder, and
replayed by ``slam-observer replay --json``. Its own memory is looked at while it runs, without
the file that it maps.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import re
import resource
import subprocess
import sys
import tempfile
import time

from mcap.writer import CompressionType, Writer
import numpy as np
from rosbags.typesys import get_typestore, Stores

from slam_observer_ros.messages.outgoing import OutgoingMessages

COUNTS = (100_000, 1_000_000, 10_000_000)
PERIOD_NS = 10_000_000
START_NS = 1_700_000_000_000_000_000
LOOK_EVERY_S = 0.05


def main() -> None:
    """Print one row a recording."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('counts', type=int, nargs='*', default=COUNTS, metavar='TWISTS')
    args = parser.parse_args()
    sys.stdout.write('| Twists | most memory, MB | CPU time, s |\n|---|---|---|\n')
    for count in args.counts:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / 'twists.mcap'
            write(path, count)
            most_mb, cpu_s = replay(path)
        sys.stdout.write(f'| {count} | {most_mb:.1f} | {cpu_s:.1f} |\n')
        sys.stdout.flush()


def write(path: Path, count: int) -> None:
    """Write a cloud of landmarks, then Twists that lead round in a circle."""
    store = get_typestore(Stores.ROS2_JAZZY)
    outgoing = OutgoingMessages(
        store.types.__getitem__, lambda data: np.frombuffer(data, np.uint8)
    )
    cloud = outgoing.point_cloud2(START_NS, 'base_link', np.arange(3), np.eye(3))
    make = store.types
    vector = make['geometry_msgs/msg/Vector3']
    twist = make['geometry_msgs/msg/Twist'](vector(1.0, 0.0, 0.0), vector(0.0, 0.0, 0.1))
    with path.open('wb') as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start('ros2', 'benchmark')
        channels = {}
        for topic, message in (('/landmarks', cloud), ('/twist', twist)):
            schema = writer.register_schema(message.__msgtype__, 'ros2msg', b'')
            channels[topic] = writer.register_channel(topic, 'cdr', schema)
        data = bytes(store.serialize_cdr(cloud, cloud.__msgtype__))
        writer.add_message(channels['/landmarks'], START_NS, data, START_NS)
        data = bytes(store.serialize_cdr(twist, twist.__msgtype__))
        for stamp_ns in range(START_NS, START_NS + count * PERIOD_NS, PERIOD_NS):
            writer.add_message(channels['/twist'], stamp_ns, data, stamp_ns)
        writer.finish()  # type: ignore[no-untyped-call]


def replay(path: Path) -> tuple[float, float]:
    """Replay a recording; return the most memory that is the program's own, MB, and CPU time."""
    command = [sys.executable, '-m', 'slam_observer_ros.cli.main', 'replay', str(path), '--json']
    most_mb, before = 0.0, resource.getrusage(resource.RUSAGE_CHILDREN)
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        status = Path(f'/proc/{process.pid}/status')
        while process.poll() is None:
            if found := re.search(r'RssAnon:\s*(\d+) kB', status.read_text(encoding='ascii')):
                most_mb = max(most_mb, int(found[1]) / 1024)
            time.sleep(LOOK_EVERY_S)
    if process.returncode:
        raise SystemExit(f'{" ".join(command)} failed')
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return most_mb, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == '__main__':
    main()
