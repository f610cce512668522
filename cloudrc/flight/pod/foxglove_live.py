# SPDX-License-Identifier: Apache-2.0

"""Serve a flight to Foxglove: `cloudrc up --foxglove` starts this module as a process.

It is a second reader of cloud's records, for which cloud never waits.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.base.errors import to_one_line
from cloudrc.config.load import read_experiment
from cloudrc.flight.interrupts import interrupt_on_signals, until_interrupted
from cloudrc.flight.pod.readers import RecordReader
from cloudrc.results.record.ros import definition
from cloudrc.results.record.topics import TOPICS, VIEWS
from cloudrc.results.report.live_views import LiveViews
from cloudrc.results.report.markers import scene_shapes
from cloudrc.results.report.shapes import read_shapes
from cloudrc.results.under_way import under_way

if TYPE_CHECKING:
    import foxglove

WAKE = 0.05
"""Longest wait for records [s]."""


def main(folder: Path, port: int) -> None:
    """Serve the flight of the run `folder` at `port` of 127.0.0.1 until it ends, or a signal."""
    import foxglove

    interrupt_on_signals()
    with ExitStack() as stack:
        stack.enter_context(until_interrupted())
        socket = Path(under_way()[folder].removeprefix("unix:"))
        world = read_experiment(str(folder / "config.yaml")).world
        shapes = read_shapes(world)
        bodies = scene_shapes(shapes, world.files.scene)
        views = LiveViews(bodies, shapes.scanner, shapes.camera)
        reader = RecordReader(socket.parent)
        stack.callback(reader.close)
        try:
            server = foxglove.start_server(name="cloudrc", port=port)
        except RuntimeError as error:
            sys.exit(
                f"foxglove: port {port}: {to_one_line(str(error))}; name another: --foxglove PORT"
            )
        stack.callback(server.stop)
        print(f"foxglove: ws://127.0.0.1:{server.port}", flush=True)
        channels = dict[str, foxglove.Channel]()
        while socket.exists():
            for record in reader.take(WAKE):
                for topic, stamp_ns, data in views.of(record):
                    if topic not in channels:
                        channels[topic] = _channel(topic)
                    channels[topic].log(data, log_time=stamp_ns)


def _channel(topic: str) -> foxglove.Channel:
    import foxglove

    kind = VIEWS.get(topic) or TOPICS[topic].ros_type
    schema = foxglove.Schema(name=kind, encoding="ros2msg", data=definition(kind).encode())
    return foxglove.Channel(topic, message_encoding="cdr", schema=schema)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
