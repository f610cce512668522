"""Serve the metrics and probes of a process over HTTP.

    exporter = Exporter("world")
    exporter.serve(("127.0.0.1", 9100))  /metrics, /healthz and /readyz, on separate threads
    exporter.see(records)                on the loop's thread: less than 1 us per record
    exporter.ready(True)                 only in a process that is not an end of the tunnel

`see` updates plain numbers. A scrape turns these numbers into Prometheus' text, at most four times
a second.

Slow or hostile clients cannot block a probe: a connection stays open for at most 5 s, and the
server closes the oldest connection when too many are open.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import socketserver
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from http.server import BaseHTTPRequestHandler
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric as Family

from cloudrc import __version__
from cloudrc.errors import MissingPrerequisiteError
from cloudrc.exposition.live import LiveMetrics
from cloudrc.exposition.parts import Histogram, Readings, unlabelled
from cloudrc.exposition.table import Kind, Labels, Metric, of_role
from cloudrc.records import Counted, Record

CONNECTIONS_MAX = 16
"""Largest number of open connections."""
LIFETIME = 5.0
"""Longest time that a connection stays open [s]; Prometheus' default scrape timeout is 10 s."""
LOOK_PERIOD = 0.25
"""Time between two checks for connections older than `LIFETIME` [s]."""
PLAIN = "text/plain; charset=utf-8"


class Answer(NamedTuple):
    """An HTTP answer: status, content and content type."""

    status: int
    content: bytes
    kind: str = PLAIN


Pages = Mapping[str, Callable[[], Answer]]


class ProbeServer(socketserver.ThreadingTCPServer):
    """Serves pages until `close` is called.

    The server does not use `http.server.HTTPServer`, which may wait for a name server.

    The accept queue is long: if a flood of connections filled the queue, the kernel would drop
    kubelet's connections, too, and kubelet's probes would fail although the process is healthy.
    """

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False
    request_queue_size = 1_024

    def __init__(self, address: tuple[str, int], pages: Pages) -> None:
        """Bind the address and start to answer.

        Args:
            address: Host and port; port 0 lets the kernel choose.
            pages: Functions that make the answers, by path.

        Raises:
            MissingPrerequisiteError: If the address cannot be bound.
        """
        self.pages = pages
        self._open: dict[Any, float] = {}
        self._guard = threading.Lock()
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        try:
            super().__init__(address, _Handler)
        except OSError as error:
            raise MissingPrerequisiteError(_explain(address, error)) from error
        self._thread = threading.Thread(
            target=self.serve_forever, args=(LOOK_PERIOD,), name="metrics", daemon=True
        )
        self._thread.start()

    def server_bind(self) -> None:
        """Bind the address; the host `::` also accepts IPv4."""
        if self.address_family == socket.AF_INET6:
            self.socket.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        super().server_bind()

    def close(self) -> None:
        """Stop the server, which takes up to 0.25 s."""
        self.shutdown()
        self.server_close()
        self._thread.join(1.0)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer on a new thread; close the oldest connection if too many are open."""
        with self._guard:
            if len(self._open) >= CONNECTIONS_MAX:
                oldest = min(self._open, key=self._open.__getitem__)
                del self._open[oldest]
                _shut_down(oldest)
            self._open[request] = time.monotonic()
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection and remove it from the open ones."""
        with self._guard:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Shut down the connections older than `LIFETIME`; called every `LOOK_PERIOD`."""
        oldest = time.monotonic() - LIFETIME
        with self._guard:
            for request, opened in self._open.items():
                if opened < oldest:
                    _shut_down(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore the errors of clients that disconnect early."""


class _Handler(BaseHTTPRequestHandler):
    """Answers one request and closes the connection."""

    server: ProbeServer
    timeout = LIFETIME

    def do_GET(self) -> None:
        """Answer with the page of the requested path, or with 404."""
        page = self.server.pages.get(self.path.partition("?")[0])
        paths = ", ".join(self.server.pages)
        answer = page() if page else Answer(404, f"there are {paths}\n".encode())
        self.send_response(answer.status)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(answer.content)))
        self.end_headers()
        self.wfile.write(answer.content)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: a request comes every few seconds."""


def _shut_down(request: socket.socket) -> None:
    """Shut down a connection; the thread that serves it then gets an error."""
    with contextlib.suppress(OSError):
        request.shutdown(socket.SHUT_RDWR)


def _explain(address: tuple[str, int], error: OSError) -> str:
    host, port = address
    if error.errno == errno.EADDRINUSE:
        return (
            f"metrics port {port} is taken: another process listens on {host}:{port};"
            " end it or choose another port with --metrics"
        )
    return f"metrics cannot be served on {host}:{port}: {error.strerror or error}; see --metrics"


ROOT = Path("/sys/fs/cgroup")
STATS = ("cpu.stat", "cpu/cpu.stat", "cpu,cpuacct/cpu.stat")
"""Files with a container's CPU counts: cgroup version 2 first, then two mounts of version 1."""


class Throttling(NamedTuple):
    """How much the CPU limit has throttled this container so far.

    Attributes:
        periods: Number of CFS periods in which a thread was runnable.
        throttled: Number of those periods in which threads were throttled.
        seconds: Throttled time, summed over all CPUs [s].
    """

    periods: int
    throttled: int
    seconds: float


def read_throttling(root: Path = ROOT) -> Throttling | None:
    """Read the counts; None if the kernel has no counts, for example outside a container.

    Source: Linux, Documentation/admin-guide/cgroup-v2.rst (throttled_usec, in us) and
    Documentation/scheduler/sched-bwc.rst (throttled_time of version 1, in ns).
    """
    for name in STATS:
        try:
            text = (root / name).read_text()
        except OSError:
            continue
        pairs = (line.split() for line in text.splitlines())
        stat = {key: int(value) for key, value in pairs}
        if "nr_periods" in stat:
            seconds = stat.get("throttled_usec", 0) * 1e-6 + stat.get("throttled_time", 0) * 1e-9
            return Throttling(stat["nr_periods"], stat["nr_throttled"], seconds)
    return None


TEXT_FORMAT = "text/plain; version=0.0.4; charset=utf-8"
"""Content type of the text that `generate_latest` makes."""
JSON = "application/json"
KEPT = 0.25
"""How long a page is reused [s]; making a page takes 1.4 ms and may delay the loop."""
CONFIG_DIGITS = 12
"""Length of the shortened hash of the process's configuration [hexadecimal digits].

In local mode the shortened hash is the beginning of the hash in report.json. In a cluster both may
differ, since plug-ins fill in their defaults later.
"""
STILL_MAX = 5.0
"""Time without a record after which a loop counts as standing still [s]; a healthy loop makes a
record every second."""


class Exporter:
    """The metrics of one process."""

    def __init__(self, role: str, *, missions: bool = True) -> None:
        """Set the role. The exporter has no records, serves nothing yet, and is not ready.

        Args:
            role: "world", "cloud", "teleop" or "link".
            missions: Whether this process exports metrics of missions; False in a cloud with a
                separate teleop, which exports them.
        """
        self._role, self._metrics = role, of_role(role)
        self._live = LiveMetrics(role, missions=missions)
        self._sync_age: Callable[[], float | None] = lambda: None
        self._said_ready, self._config = False, ""
        self._seen_at: float | None = None  # None: the loop has not begun, so it is not dead
        self._server: ProbeServer | None = None
        self._page_lock = threading.Lock()
        self._made_at, self._made_page = -inf, Answer(503, b"")
        self._registry = CollectorRegistry()
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def see(self, records: Iterable[Record]) -> None:
        """Update the metrics with records of this process, oldest first, without waiting."""
        self._seen_at = time.monotonic()
        self._live.see(records)

    def ready(self, ready: bool) -> None:
        """Set whether this process is ready; not for world and cloud, whose records show this."""
        self._seen_at = time.monotonic()
        self._said_ready = ready

    def runs(self, fingerprint: str) -> None:
        """Set the hash of the configuration that this process runs."""
        self._config = fingerprint[:CONFIG_DIGITS]

    def shaped(self, shaper: str, direction: str, mode: str) -> None:
        """Set the shaper of a direction of the link; only with the role "link".

        Args:
            shaper: "relay" or "netem".
            direction: "uplink" or "downlink".
            mode: The shaper that the user asked for: "auto", "relay" or "netem".
        """
        assert self._live.link is not None, "only a link is shaped"
        self._live.link.shaped(shaper, direction, mode)

    def asked(self, direction: str, delay: float) -> None:
        """Set the mean delay [s] of the profile in force; only with the role "link"."""
        assert self._live.link is not None, "only a link is shaped"
        self._live.link.asked(direction, delay)

    def unresolved(self, count: int) -> None:
        """Set how many times the peer's name could not be resolved, from any thread."""
        self._live.see([Counted(0, "link", "unresolved", count)])

    def recording(self, sync_age: Callable[[], float | None]) -> None:
        """Set the function that returns the time since the last sync [s]; None before any sync."""
        self._sync_age = sync_age

    def tells(self, tell: Callable[[], str]) -> None:
        """Set the function that makes the JSON of /link.json; only with the role "link"."""
        assert self._live.link is not None, "an end serves its own check"
        self._live.link.tell = tell

    @property
    def is_ready(self) -> bool:
        """Whether `ready` was set or, for an end of the tunnel, its peer has answered."""
        return self._said_ready or (self._live.end is not None and self._live.end.has_peer)

    def serve(self, address: tuple[str, int]) -> int:
        """Start to answer at a host and port.

        Returns:
            The port; for port 0, the port that the kernel has chosen.

        Raises:
            MissingPrerequisiteError: If the address cannot be bound.
        """
        pages = {"/metrics": self._page, "/healthz": self._liveness, "/readyz": self._readiness}
        end, link = self._live.end, self._live.link
        if end is not None:
            pages["/link.json"] = lambda: Answer(200, end.check.text().encode(), JSON)
        if link is not None:
            pages["/link.json"] = lambda: Answer(200, link.tell().encode(), JSON)
        self._server = ProbeServer(address, pages)
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Stop the server."""
        if self._server is not None:
            self._server.close()
            self._server = None

    def collect(self) -> Iterator[Family]:
        """Yield all current metrics to the registry."""
        readings = self._live.read() | self._process_readings()
        for metric in self._metrics:
            reading = readings.get(metric.name)
            if reading:
                yield _family(metric, reading)

    def _process_readings(self) -> Readings:
        readings: Readings = {
            "cloudrc_build_info": {(__version__, self._role, self._config): 1.0},
            "cloudrc_ready": unlabelled(self.is_ready),
        }
        if (age := self._sync_age()) is not None:
            readings["cloudrc_recorder_sync_age_seconds"] = unlabelled(age)
        throttling = read_throttling()
        if throttling is not None:
            readings["cloudrc_cpu_periods_total"] = unlabelled(throttling.periods)
            readings["cloudrc_cpu_throttled_periods_total"] = unlabelled(throttling.throttled)
            readings["cloudrc_cpu_throttled_seconds_total"] = unlabelled(throttling.seconds)
        return readings

    def text(self) -> str:
        """Format the metrics for Prometheus."""
        return generate_latest(self._registry).decode()

    def _page(self) -> Answer:
        """Return a text at most `KEPT` old; requests wait while a new text is made."""
        with self._page_lock:
            now = time.monotonic()
            if now - self._made_at >= KEPT:
                self._made_at = now
                self._made_page = Answer(200, self.text().encode(), TEXT_FORMAT)
            return self._made_page

    def _readiness(self) -> Answer:
        return Answer(200, b"ready\n") if self.is_ready else Answer(503, b"no peer yet\n")

    def _liveness(self) -> Answer:
        """Answer whether this process's own loop runs, independently of link and other end."""
        still = None if self._seen_at is None else time.monotonic() - self._seen_at
        if still is None or still <= STILL_MAX:
            return Answer(200, b"alive\n")
        return Answer(503, f"the loop has stood still for {still:.0f} s\n".encode())


def _family(metric: Metric, reading: dict[Labels, float] | Histogram) -> Family:
    """Convert a reading to a metric family of prometheus_client."""
    name, names = metric.name, list(metric.labels)
    if isinstance(reading, Histogram):
        bounds = [*map(str, reading.bounds), "+Inf"]
        buckets = list(zip(bounds, reading.cumulative(), strict=True))
        return HistogramMetricFamily(name, metric.meaning, buckets, reading.total)
    counts = metric.kind is Kind.COUNTER
    family = (CounterMetricFamily if counts else GaugeMetricFamily)(
        name, metric.meaning, labels=names
    )
    for labels, value in reading.items():
        family.add_metric(labels, value)
    return family
