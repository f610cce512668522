# SPDX-License-Identifier: Apache-2.0

"""Serve the metrics and the health checks of a process over HTTP, on separate threads."""

from __future__ import annotations

import socket
import socketserver
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric as Family

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.flight.pod.http import TEXT, HttpHandler
from cloudrc.flight.pod.servers import ThreadedServer
from cloudrc.link.state import LinkState
from cloudrc.results.exposition.live import CellMetrics, LinkMetrics, LiveMetrics
from cloudrc.results.exposition.parts import Histogram, Readings, samples
from cloudrc.results.exposition.table import Labels, LiveMetric, MetricKind, of_role
from cloudrc.version import __version__
from cloudrc.wire.records import Counted, Record

TEXT_FORMAT = "text/plain; version=0.0.4; charset=utf-8"
"""Content type of Prometheus' text format."""
CLIENT_WAIT_MAX = 5.0
"""Longest wait for data from or to a client [s]."""
CONNECTIONS_MAX = 16
"""Largest number of open connections. A further connection closes the oldest one, so that idle
clients cannot use up the files or threads of the process."""
CONFIG_DIGITS = 12
"""Number of hexadecimal digits of the configuration's hash in the metrics."""
STILL_MAX = 5.0
"""Time without a record after which the control loop counts as stopped [s]. A running loop makes at
least one record per second."""
CGROUP = Path("/sys/fs/cgroup")
CPU_COUNTS = ("cpu.stat", "cpu/cpu.stat", "cpu,cpuacct/cpu.stat")
"""Files below `CGROUP` that may contain a container's CPU counts: one for cgroup v2, two for v1."""


class Answer(NamedTuple):
    """An HTTP answer: status, content and content type."""

    status: int
    content: str
    kind: str = TEXT


class _Server(ThreadedServer, socketserver.TCPServer):
    """Answers each request on its own thread.

    Unlike `http.server.HTTPServer`, it never waits for a name server. The queue of new connections
    is long, so that health checks by Kubernetes succeed during a burst of connections.
    """

    request_queue_size = 1_024

    def __init__(self, address: tuple[str, int], pages: Mapping[str, Callable[[], Answer]]) -> None:
        self.pages, self._newest = pages, deque[socket.socket]()
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        super().__init__(address, _Handler)
        self.start()

    def server_bind(self) -> None:
        """Bind the address; the host `::` accepts IPv6 and IPv4."""
        if self.address_family == socket.AF_INET6:
            self.socket.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        super().server_bind()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer on a new thread; above `CONNECTIONS_MAX`, close the oldest connection."""
        self._newest.append(request)
        if len(self._newest) > CONNECTIONS_MAX:
            with suppress(OSError):  # the client has its answer
                self._newest.popleft().shutdown(socket.SHUT_RDWR)
        super().process_request(request, client_address)


class _Handler(HttpHandler):
    server: _Server
    timeout = CLIENT_WAIT_MAX

    def do_GET(self) -> None:  # noqa: N802
        page = self.server.pages.get(self.path.partition("?")[0])
        self.answer(
            *(page() if page else Answer(404, f"there are {', '.join(self.server.pages)}\n"))
        )


def read_throttling(root: Path = CGROUP) -> Readings:
    """Read how much the CPU limit has throttled this container; {} outside a container.

    Source: Linux, Documentation/admin-guide/cgroup-v2.rst (throttled_usec, in us) and
    Documentation/scheduler/sched-bwc.rst (throttled_time of version 1, in ns).
    """
    for name in CPU_COUNTS:
        try:
            words = (line.split() for line in (root / name).read_text().splitlines())
        except OSError:
            continue
        counts = {key: int(number) for key, number in words}
        if "nr_periods" in counts:
            stopped = counts.get("throttled_usec", 0) * 1e-6
            stopped += counts.get("throttled_time", 0) * 1e-9
            return {
                "cloudrc_cpu_periods_total": samples(counts["nr_periods"]),
                "cloudrc_cpu_throttled_periods_total": samples(counts["nr_throttled"]),
                "cloudrc_cpu_throttled_seconds_total": samples(stopped),
            }
    return {}


class Exporter:
    """Collects the metrics of one process and serves them over HTTP.

    Attributes:
        sync_age: Returns the time since the recording's last sync to disk [s], None if unknown.
    """

    def __init__(self, role: str, config: str = "") -> None:
        """Set the role of the process, one of `ROLES`.

        `config` is the hash of the process's configuration.
        """
        self._role, self._metrics = role, of_role(role)
        self._live = LiveMetrics(role)
        self.sync_age: Callable[[], float | None] = lambda: None
        self._said_ready, self._config = False, config[:CONFIG_DIGITS]
        self._seen_at: float | None = None  # time of the newest records; None before the first
        self._server: _Server | None = None
        self._registry = CollectorRegistry()
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def see(self, records: Iterable[Record]) -> None:
        """Update the metrics with records, oldest first, in 1 to 2 us per record."""
        self._seen_at = time.monotonic()
        self._live.see(records)

    def ready(self, ready: bool) -> None:
        """Set whether this process is ready; teleop, link and cell call this method.

        World and cloud are ready while the peer sends.
        """
        self._seen_at = time.monotonic()
        self._said_ready = ready

    @property
    def link(self) -> LinkMetrics:
        """The metrics of the emulated link; only an exporter with the role "link" has them."""
        assert self._live.link is not None, "only a link is shaped"
        return self._live.link

    @property
    def cell(self) -> CellMetrics:
        """The metrics of the cell of a fleet; only an exporter with the role "cell" has them."""
        assert self._live.cell is not None, "this is no cell"
        return self._live.cell

    def shaped(self, state: LinkState) -> None:
        """Take the state of the direction that this process shapes: now it is ready."""
        self.link.shaped(state.shaper, state.direction, state.mode, state.asked["delay"] or 0.0)
        self.ready(True)

    def counted(self, counts: Mapping[str, int]) -> None:
        """Update the counters of the emulated link; `counts`: name -> value."""
        self.see(Counted(0, "link", name, number) for name, number in counts.items())

    def unresolved(self, count: int) -> None:
        """Set the number of failed DNS queries for the peer's name. Any thread may call this."""
        self._live.see([Counted(0, "link", "unresolved", count)])

    @property
    def is_ready(self) -> bool:
        """Whether this process is ready: world or cloud if the peer sends, others by `ready`."""
        return self._said_ready or (self._live.end is not None and self._live.end.has_peer)

    def serve(self, address: tuple[str, int]) -> int:
        """Start to serve at a host and port; return the port. For port 0 the kernel chooses one.

        Raise a MissingPrerequisiteError if the address cannot be bound.
        """
        pages = {"/metrics": self._page, "/healthz": self._liveness, "/readyz": self._readiness}
        end, link = self._live.end, self._live.link
        if end is not None:
            pages["/link.json"] = lambda: Answer(200, end.link_text(), "application/json")
        if link is not None:
            pages["/link.json"] = lambda: Answer(200, link.tell(), "application/json")
        try:
            self._server = _Server(address, pages)
        except OSError as error:
            raise MissingPrerequisiteError(
                f"metrics cannot be served on {address[0]}:{address[1]}: {error.strerror or error};"
                " end what listens there, or choose another address with --metrics"
            ) from error
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Stop the server."""
        if self._server is not None:
            self._server.close()
            self._server = None

    def collect(self) -> Iterator[Family]:
        """Yield all current metrics; the registry of prometheus_client calls this."""
        readings: Readings = self._live.read() | read_throttling()
        readings["cloudrc_build_info"] = {(__version__, self._role, self._config): 1.0}
        readings["cloudrc_ready"] = samples(self.is_ready)
        if (age := self.sync_age()) is not None:
            readings["cloudrc_recorder_sync_age_seconds"] = samples(age)
        for metric in self._metrics:
            if reading := readings.get(metric.name):
                yield _family(metric, reading)

    def text(self) -> str:
        """Format the metrics for Prometheus."""
        return generate_latest(self._registry).decode()

    def _page(self) -> Answer:
        return Answer(200, self.text(), TEXT_FORMAT)

    def _readiness(self) -> Answer:
        return Answer(200, "ready\n") if self.is_ready else Answer(503, "no peer yet\n")

    def _liveness(self) -> Answer:
        """Answer whether the loop of this process runs, even if the link or the peer is down."""
        still = 0.0 if self._seen_at is None else time.monotonic() - self._seen_at
        if still <= STILL_MAX:
            return Answer(200, "alive\n")
        return Answer(503, f"the loop has stood still for {still:.0f} s\n")


def _family(metric: LiveMetric, reading: dict[Labels, float] | Histogram) -> Family:
    if isinstance(reading, Histogram):
        bounds = [*map(str, reading.bounds), "+Inf"]
        buckets = list(zip(bounds, reading.cumulative(), strict=True))
        return HistogramMetricFamily(metric.name, metric.meaning, buckets, reading.total)
    kind = CounterMetricFamily if metric.kind is MetricKind.COUNTER else GaugeMetricFamily
    family = kind(metric.name, metric.meaning, labels=list(metric.labels))
    for labels, value in reading.items():
        family.add_metric(labels, value)
    return family
