"""`cloudrc sweep run --on kubernetes` flies a sweep in pods, which run `cloudrc sweep rows`."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Generator, Sequence
from typing import TYPE_CHECKING

from cloudrc import __version__
from cloudrc.cli.cluster_flags import release_arguments, release_from_flags
from cloudrc.cli.output import print_line
from cloudrc.cli.parser import read_count
from cloudrc.cli.pool import interrupt_on_signals

if TYPE_CHECKING:
    from cloudrc.sweep.flight import Row
    from cloudrc.sweep.plan import Flight, Plan

IMAGE = f"cloudrc/world:{__version__}"


def cluster_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of a sweep on a cluster."""
    add = release_arguments(parser)
    about = "fly in the pods of a Job instead of on this machine"
    add("--on", choices=("kubernetes",), help=about)
    add("--shards", type=read_count, default=8, metavar="N", help="number of pods (default: 8)")
    about = f"image of the pods (default: {IMAGE})"
    add("--image", default=IMAGE, metavar="IMAGE", help=about)
    add("--cpu", default="1", metavar="CPU", help="CPU request of a pod (default: 1)")
    add("--queue", metavar="NAME", help="queue of Kueue that admits the Job")


def rows_from_pods(
    options: argparse.Namespace, plan: Plan, flights: Sequence[Flight]
) -> Generator[Row]:
    """Fly flights of a plan on a cluster, and yield each row once.

    Each pod of a Job flies a share (shard) of the flights and logs their rows. If a pod is deleted
    just after its last flight, its log is lost, but Kubernetes counts its shard as complete.
    Therefore further Jobs fly the flights without a row.

    Raises:
        ClusterError: If a Job fails or yields no row, or if a pod will never run.
    """
    from cloudrc.cluster import batch
    from cloudrc.cluster.client import ClusterError
    from cloudrc.sweep.plan import pack
    from cloudrc.sweep.store import parse_row

    def tell(text: str) -> None:
        print_line(f"  {text}", sys.stderr)

    release = release_from_flags(options)
    every = "".join(plan.flights).encode() + str(options.shards).encode()
    name = f"sweep-{hashlib.sha256(every).hexdigest()[:12]}"
    words = {"image": options.image, "cpu": options.cpu, "queue": options.queue}
    missing = {flight.key: flight for flight in flights}
    while missing:
        before = len(missing)
        batch.start(release, name, pack(missing.values()), options.shards, **words)
        tell(
            f"Job '{name}' {release.where}, {options.shards} pods; it goes on without this command"
        )
        for line in batch.read_lines(release, name, tell):
            row = parse_row(line)
            if row is not None and missing.pop(row["key"], None) is not None:
                yield row
        if len(missing) == before:
            text = "the same command flies them; is the image of this version of cloudrc?"
            raise ClusterError(f"the pods printed no row of {before} flights; {text}")
        if missing:
            tell(f"the rows of {len(missing)} flights were lost with their pods")


def print_rows(options: argparse.Namespace) -> int:
    """Fly one shard (part) of the flights in a file; print the result of each flight as a row."""
    from cloudrc.sweep.flight import fly_point
    from cloudrc.sweep.plan import unpack
    from cloudrc.sweep.store import make_row

    interrupt_on_signals()  # the first process of a container ignores signals by default
    shard, count = options.shard
    for flight in unpack(options.file)[shard - 1 :: count]:
        row = make_row(flight, fly_point(flight.experiment))
        print(json.dumps(row, allow_nan=False), flush=True)
    return 0
