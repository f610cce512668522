# SPDX-License-Identifier: Apache-2.0

"""Fly flights of a sweep in the pods of a cluster, which run `cloudrc sweep rows`."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Generator, Sequence

from cloudrc.cluster import batch
from cloudrc.cluster.batch import PodSettings
from cloudrc.cluster.client import ClusterError, Release
from cloudrc.flight.trials.plan import PlannedFlight, SweepPlan, pack
from cloudrc.flight.trials.rows import Row, parse_row


def fly_in_pods(
    release: Release,
    settings: PodSettings,
    plan: SweepPlan,
    flights: Sequence[PlannedFlight],
    tell: Callable[[str], None],
) -> Generator[Row]:
    """Fly flights of a plan on a cluster, and yield each row once.

    Each pod of a Job flies a share (shard) of the flights and logs their rows. If a pod is deleted
    just after its last flight, its log is lost, but Kubernetes counts its shard as complete.
    Therefore further Jobs fly the flights without a row.

    Raises:
        ClusterError: If a Job fails or yields no row, or if a pod will never run.
    """
    release = release.patient(tell)
    every = "".join(plan.flights).encode()
    name = f"sweep-{hashlib.sha256(every).hexdigest()[:12]}"
    if settings.image is None:
        settings = settings._replace(image=batch.image_for(plan.points))
    missing = {flight.key: flight for flight in flights}
    while missing:
        before = len(missing)
        settings = settings._replace(shards=min(settings.shards, before))
        batch.start(release, name, pack(missing.values()), settings, plan.own_files)
        where = f"{release.where}, {settings.shards} pods"
        store = settings.claim or settings.bucket
        kept = f", rows in {store}/{name}" if store else ""
        tell(f"Job '{name}' {where}{kept}; it goes on without this command")
        for line in batch.read_lines(release, name, tell):
            row = parse_row(line)
            if row is not None and missing.pop(row["key"], None) is not None:
                yield row
        if len(missing) == before:
            text = "the same command flies them; is the image of this version of cloudrc?"
            raise ClusterError(f"the pods printed no row of {before} flights; {text}")
        if missing:
            tell(f"the rows of {len(missing)} flights were lost with their pods")
