"""Serve the metrics and the health checks of a process over HTTP, on separate threads."""

from __future__ import annotations

import socket
import socketserver
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric as Family

from cloudrc import __version__
from cloudrc.errors import MissingPrerequisiteError
from cloudrc.exposition.live import Link, LiveMetrics
from cloudrc.exposition.parts import Histogram, Readings, unlabelled
from cloudrc.exposition.table import Kind, Labels, Metric, of_role
from cloudrc.records import Counted, Record

TEXT_FORMAT = "text/plain; version=0.0.4; charset=utf-8"
"""Content type of Prometheus' text format."""
PLAIN, JSON = "text/plain; charset=utf-8", "application/json"
CLIENT_WAIT_MAX = 5.0
"""Longest wait for data from or to a client [s]; idle clients then free their threads."""
CONFIG_DIGITS = 12
"""Number of hexadecimal digits of the configuration's hash in the metrics."""
STILL_MAX = 5.0
"""Time without a record after which the control loop counts as stopped [s]. A running loop makes at
least one record per second."""
CPU_COUNTS = Path("/sys/fs/cgroup/cpu.stat")
"""File with the CPU counts of this container (cgroup version 2)."""
Answer = tuple[int, str, str]
"""An HTTP answer: status, content and content type."""
NO_PEER: Answer = (503, "no peer yet\n", PLAIN)


class _Server(socketserver.ThreadingTCPServer):
    """Answers each request on its own thread.

    `http.server.HTTPServer` may wait for a name server and is therefore not used. The queue of new
    connections is long, so that health checks by Kubernetes succeed during a burst of connections.
    """

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False
    request_queue_size = 1_024

    def __init__(self, address: tuple[str, int], pages: Mapping[str, Callable[[], Answer]]) -> None:
        self.pages = pages
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        super().__init__(address, _Handler)
        threading.Thread(target=self.serve_forever, args=(0.25,), daemon=True).start()

    def server_bind(self) -> None:
        """Bind the address; the host `::` accepts IPv6 and IPv4."""
        if self.address_family == socket.AF_INET6:
            self.socket.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        super().server_bind()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore the errors of clients that disconnect early."""


class _Handler(BaseHTTPRequestHandler):
    """Answers one request and closes the connection."""

    server: _Server
    timeout = CLIENT_WAIT_MAX

    def do_GET(self) -> None:
        """Answer with the page of the requested path, or with 404."""
        page = self.server.pages.get(self.path.partition("?")[0])
        missing = 404, f"there are {', '.join(self.server.pages)}\n", PLAIN
        status, text, kind = page() if page else missing
        content = text.encode()
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing, because a request arrives every few seconds."""


def read_throttling(path: Path = CPU_COUNTS) -> Readings:
    """Read how much the CPU limit has throttled this container; {} without a limit.

    Source: Linux, Documentation/admin-guide/cgroup-v2.rst (throttled_usec, in us).
    """
    try:
        counts = dict(line.split() for line in path.read_text().splitlines())
    except OSError:
        return {}
    if "nr_periods" not in counts:
        return {}
    return {
        "cloudrc_cpu_periods_total": unlabelled(int(counts["nr_periods"])),
        "cloudrc_cpu_throttled_periods_total": unlabelled(int(counts["nr_throttled"])),
        "cloudrc_cpu_throttled_seconds_total": unlabelled(int(counts["throttled_usec"]) * 1e-6),
    }


class Exporter:
    """Collects the metrics of one process and serves them over HTTP."""

    def __init__(self, role: str, config: str = "", *, missions: bool = True) -> None:
        """Set the role of the process: "world", "cloud", "teleop" or "link".

        `config` is the hash of the process's configuration. `missions` is False in cloud if a
        separate teleop process exports the metrics of missions.
        """
        self._role, self._metrics = role, of_role(role)
        self._live = LiveMetrics(role, missions=missions)
        self._sync_age: Callable[[], float | None] = lambda: None
        self._said_ready, self._config = False, config[:CONFIG_DIGITS]
        self._seen_at: float | None = None  # time of the newest records; None before the first
        self._server: _Server | None = None
        self._registry = CollectorRegistry()
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def see(self, records: Iterable[Record]) -> None:
        """Update the metrics with records, oldest first, in less than 1 us per record."""
        self._seen_at = time.monotonic()
        self._live.see(records)

    def ready(self, ready: bool) -> None:
        """Set whether teleop or a link is ready. For world and cloud, the records show this."""
        self._seen_at = time.monotonic()
        self._said_ready = ready

    @property
    def link(self) -> Link:
        """The metrics of the emulated link. Only the role "link" has them."""
        assert self._live.link is not None, "only a link is shaped"
        return self._live.link

    def shaped(self, shaper: str, direction: str, mode: str) -> None:
        """Set the shaper that acts on a direction, "relay" or "netem", and the requested mode."""
        self.link.shaped(shaper, direction, mode)

    def asked(self, direction: str, delay: float) -> None:
        """Set the mean delay [s] that the current profile requests for a direction."""
        self.link.asked(direction, delay)

    def unresolved(self, count: int) -> None:
        """Set the number of failed DNS queries for the peer's name. Any thread may call this."""
        self._live.see([Counted(0, "link", "unresolved", count)])

    def recording(self, sync_age: Callable[[], float | None]) -> None:
        """Set the function that returns the time since the recording's last sync to disk [s]."""
        self._sync_age = sync_age

    @property
    def is_ready(self) -> bool:
        """Whether `ready` was set or, in world and cloud, whether the peer's datagrams arrive."""
        return self._said_ready or (self._live.end is not None and self._live.end.has_peer)

    def serve(self, address: tuple[str, int]) -> int:
        """Start to serve at a host and port; return the port. For port 0 the kernel chooses one.

        Raise a MissingPrerequisiteError if the address cannot be bound.
        """
        pages: dict[str, Callable[[], Answer]] = {
            "/metrics": lambda: (200, self.text(), TEXT_FORMAT),
            "/healthz": self._liveness,
            "/readyz": lambda: (200, "ready\n", PLAIN) if self.is_ready else NO_PEER,
        }
        end, link = self._live.end, self._live.link
        if end is not None:
            pages["/link.json"] = lambda: (200, end.check.text(), JSON)
        if link is not None:
            pages["/link.json"] = lambda: (200, link.tell(), JSON)
        try:
            self._server = _Server(address, pages)
        except OSError as error:
            raise MissingPrerequisiteError(
                f"metrics cannot be served on {address[0]}:{address[1]}: {error.strerror or error};"
                " end what listens there, or choose another address with --metrics"
            ) from error
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Stop the server; this takes up to 0.25 s."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()
            self._server = None

    def collect(self) -> Iterator[Family]:
        """Yield all current metrics; the registry of prometheus_client calls this."""
        readings: Readings = self._live.read() | read_throttling()
        readings["cloudrc_build_info"] = {(__version__, self._role, self._config): 1.0}
        readings["cloudrc_ready"] = unlabelled(self.is_ready)
        if (age := self._sync_age()) is not None:
            readings["cloudrc_recorder_sync_age_seconds"] = unlabelled(age)
        for metric in self._metrics:
            if reading := readings.get(metric.name):
                yield _family(metric, reading)

    def text(self) -> str:
        """Format the metrics for Prometheus."""
        return generate_latest(self._registry).decode()

    def _liveness(self) -> Answer:
        """Answer whether the loop of this process runs, even if the link or the peer is down."""
        still = 0.0 if self._seen_at is None else time.monotonic() - self._seen_at
        if still <= STILL_MAX:
            return 200, "alive\n", PLAIN
        return 503, f"the loop has stood still for {still:.0f} s\n", PLAIN


def _family(metric: Metric, reading: dict[Labels, float] | Histogram) -> Family:
    if isinstance(reading, Histogram):
        bounds = [*map(str, reading.bounds), "+Inf"]
        buckets = list(zip(bounds, reading.cumulative(), strict=True))
        return HistogramMetricFamily(metric.name, metric.meaning, buckets, reading.total)
    kind = CounterMetricFamily if metric.kind is Kind.COUNTER else GaugeMetricFamily
    family = kind(metric.name, metric.meaning, labels=list(metric.labels))
    for labels, value in reading.items():
        family.add_metric(labels, value)
    return family
