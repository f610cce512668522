# SPDX-License-Identifier: Apache-2.0

"""Ask a release in flight whether its link matches its profile.

No probes are sent: world and cloud each compare the datagrams that they receive with the profile.
They serve their verdicts at /link.json on their metrics ports. The link containers serve the state
of their shapers at the same path.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from math import nan
from typing import Any, TypeAlias

from cloudrc.base.errors import TimedOutError
from cloudrc.base.outside.prometheus import read_metrics
from cloudrc.cluster.client import Release
from cloudrc.cluster.pods import METRICS, find_pod, forwarded
from cloudrc.flight.links.under_test import LOOPBACK, WAYS
from cloudrc.flight.links.verify import Report, fetch, make_report
from cloudrc.link.verify.causes import Findings, read_evidence
from cloudrc.link.verify.judge import Judgement

RELEASE_TIMEOUT = 270.0  # default time limit for the verdict on a release [s]
POLL_PERIOD = 2.0  # between requests to a release [s]
PORTS = METRICS["world"]["world"], METRICS["world"]["link"]
KEYS = ("asked", "measured", "low", "high")
Pods: TypeAlias = Mapping[str, Sequence[str]]
"""World or cloud -> two URLs: the metrics port of the process, and that of its link container."""


def pods_at(hosts: Sequence[str]) -> Pods:
    """Return the URLs of the metrics of both pods, at the hosts of world and cloud."""
    world, cloud = ([f"http://{host}:{port}" for port in PORTS] for host in hosts)
    return {"world": world, "cloud": cloud}


@contextlib.contextmanager
def forwarded_pods(release: Release) -> Iterator[Pods]:
    """Forward the metrics of both pods of a release while the `with` block runs."""
    pods = {}
    with contextlib.ExitStack() as stack:
        for end in ("world", "cloud"):
            pod = find_pod(release, end).metadata.name
            local = stack.enter_context(forwarded(release, pod, PORTS))
            pods[end] = [f"http://{LOOPBACK}:{local[port]}" for port in PORTS]
        yield pods


def verify_release(title: str, pods: Pods, limit: float = RELEASE_TIMEOUT) -> Report:
    """Fetch the verdicts on both directions of a release's link, and report them.

    World judges the downlink, cloud the uplink. Wait at most `limit` [s] for both verdicts.

    Raises:
        TimedOutError: If world or cloud does not answer in time.
    """
    seen = _await_verdicts(pods, limit)
    if silent := [receiver for way, (_, receiver, _) in WAYS.items() if way not in seen]:
        text = f"{' and '.join(silent)} did not answer within {limit:g} s: are the pods ready?"
        raise TimedOutError(text)
    return make_report(title, {way: _findings(seen[way], pods[WAYS[way][0]][1]) for way in WAYS})


def _await_verdicts(pods: Pods, limit: float) -> dict[str, Any]:
    """Return the newest answer about each direction, once both are decided or after `limit` [s]."""
    deadline, seen = time.monotonic() + limit, dict[str, Any]()
    while True:
        time.sleep(POLL_PERIOD)
        for way, (_, receiver, _) in WAYS.items():
            if page := fetch(f"{pods[receiver][0]}/link.json"):
                seen[way] = json.loads(page)
        decided = [one["verdict"] in ("ok", "off") for one in seen.values()] == [True, True]
        if decided or time.monotonic() >= deadline:
            return seen


def _findings(found: Mapping[str, Any], link: str) -> Findings:
    """Combine the receiver's verdict `found` with the link container's report at the URL `link`."""
    page, rows = json.loads(fetch(f"{link}/link.json") or "{}"), []
    for one in found["rows"]:
        asked, measured, low, high = (float(one.get(key, nan)) for key in KEYS)
        rows.append(Judgement(one["quantity"], asked, measured, low, high, one["verdict"]))
    count = max((one["datagrams"] for one in found["rows"]), default=0)
    known = read_evidence(page, read_metrics(fetch(f"{link}/metrics")))
    return Findings(rows, known, f"{count} of the tunnel's own datagrams")
