"""The metrics of a process: fed with its records like the recorder, scraped by Prometheus.

    exporter = Exporter("world")
    exporter.serve("127.0.0.1:9100")    /metrics, /healthz and /readyz, on threads of their own
    exporter.see(records)               on the loop's thread: less than 1 us per record
    exporter.ready(True)                a process that is no end of the tunnel says when it is

What `see` takes in is kept in plain numbers; Prometheus' text is made of them when it is scraped,
at most four times a second.

The small HTTP server of every process: metrics and probes, answered on threads of their own.

No client can do harm: a connection lives 5 s at most, whatever it sends or does not read, and when
too many are open the oldest gives way, so that a probe always gets its answer.

CPU throttling of this container: the kernel's cpu.stat comes in, counts and seconds go out.
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
from cloudrc.exposition.live import Live
from cloudrc.exposition.parts import Histogram, Readings, plain
from cloudrc.exposition.table import Kind, Labels, Metric, of_role
from cloudrc.records import Counted, Record

CONNECTIONS_MAX = 16
LIFETIME = 5.0
"""Of one connection [s]; the scrape timeout of Prometheus is 10 s by default."""
LOOK_PERIOD = 0.25
"""How often it is looked for connections that have lived too long [s]."""
PLAIN = "text/plain; charset=utf-8"


class Answer(NamedTuple):
    """What a path answers: HTTP status, content and its type."""

    status: int
    content: bytes
    kind: str = PLAIN


Pages = Mapping[str, Callable[[], Answer]]


class ProbeServer(socketserver.ThreadingTCPServer):
    """Serves pages until it is closed.

    Not `http.server.HTTPServer`, which asks the name service for its own name, and may wait for it.
    A flood of connections fills the queue of those that wait to be taken, and behind a full one the
    kernel drops kubelet's, too: tried again after 1 s, perhaps in vain, its probe fails after 2 or
    5 s, though nothing is wrong. So the queue is as long as that of the API.
    """

    allow_reuse_address = True
    daemon_threads = True
    block_on_close = False
    request_queue_size = 1_024

    def __init__(self, address: tuple[str, int], pages: Pages) -> None:
        """Bind and begin to answer.

        Args:
            address: Host and port; port 0 lets the kernel choose.
            pages: By path.

        Raises:
            MissingPrerequisiteError: If the address cannot be had.
        """
        self.pages = pages
        self._open: dict[Any, float] = {}
        self._guard = threading.Lock()
        try:
            super().__init__(address, _Handler)
        except OSError as error:
            raise MissingPrerequisiteError(_explain(address, error)) from error
        self._thread = threading.Thread(
            target=self.serve_forever, args=(LOOK_PERIOD,), name="metrics", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop answering; takes a quarter of a second."""
        self.shutdown()
        self.server_close()
        self._thread.join(1.0)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer on a thread; the oldest connection gives way if there are too many."""
        with self._guard:
            if len(self._open) >= CONNECTIONS_MAX:
                oldest = min(self._open, key=self._open.__getitem__)
                del self._open[oldest]
                _cut(oldest)
            self._open[request] = time.monotonic()
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Forget and close a connection, however it ended."""
        with self._guard:
            self._open.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        """Now and then: cut the connections that have lived long enough."""
        until = time.monotonic() - LIFETIME
        with self._guard:
            for request, since in self._open.items():
                if since < until:
                    _cut(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that leaves early is no news."""


class _Handler(BaseHTTPRequestHandler):
    """Answers one request and closes the connection."""

    server: ProbeServer
    timeout = LIFETIME

    def do_GET(self) -> None:
        """Answer with the page, if there is one."""
        page = self.server.pages.get(self.path.partition("?")[0])
        paths = ", ".join(self.server.pages)
        answer = page() if page else Answer(404, f"there are {paths}\n".encode())
        self.send_response(answer.status)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(answer.content)))
        self.end_headers()
        self.wfile.write(answer.content)

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged: there is one every few seconds."""


def _cut(request: socket.socket) -> None:
    """End a connection under the thread that serves it, which then notices."""
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
"""Version 2 first; the others are mounts of version 1. A container sees its own group there."""


class Throttling(NamedTuple):
    """What the CPU limit has done so far.

    Attributes:
        periods: CFS periods in which something wanted to run.
        throttled: Those of them in which it was stopped.
        seconds: For how long, over all CPUs [s].
    """

    periods: int
    throttled: int
    seconds: float


def read_throttling(root: Path = ROOT) -> Throttling | None:
    """Read the counts; None where the kernel keeps none, as outside of containers.

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
"""What `generate_latest` writes."""
JSON = "application/json"
KEPT = 0.25
"""A page is shown to whoever asks within this time [s]. To make one takes 1.4 ms, for which the
loop may have to wait: four a second are less than one wake in a hundred."""
CONFIG_DIGITS = 12
"""Of the hash of the configuration that the process was given, as git shortens one. A run on one
machine gives all, and report.json has the whole hash of that; in a cluster its hash may be another,
for there what plug-ins fill in is left open."""
STILL_MAX = 5.0
"""A loop that has said nothing for so long stands still [s]; each says something every second."""


class Exporter:
    """The metrics of one process."""

    def __init__(self, role: str, *, missions: bool = True) -> None:
        """Begin with nothing seen, served or ready.

        Args:
            role: "world", "cloud", "teleop" or "link".
            missions: Whether they are told here; False in a cloud whose teleop tells them.
        """
        self._role, self._metrics = role, of_role(role)
        self._live = Live(role, missions=missions)
        self._sync_age: Callable[[], float | None] = lambda: None
        self._said_ready, self._config = False, ""
        self._seen_at: float | None = None  # no loop is alive or dead before it has begun
        self._server: ProbeServer | None = None
        self._making = threading.Lock()
        self._made_at, self._made = -inf, Answer(503, b"")
        self._registry = CollectorRegistry()
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def see(self, records: Iterable[Record]) -> None:
        """Take in records of this process, oldest first; never waits."""
        self._seen_at = time.monotonic()
        self._live.see(records)

    def ready(self, ready: bool) -> None:
        """Say whether this process is ready; world and cloud need not, their records tell."""
        self._seen_at = time.monotonic()
        self._said_ready = ready

    def runs(self, fingerprint: str) -> None:
        """Say the hash of the configuration by which this process runs."""
        self._config = fingerprint[:CONFIG_DIGITS]

    def shaped(self, shaper: str, direction: str, mode: str) -> None:
        """Say who shapes a direction of the link from now on; only with the role "link".

        Args:
            shaper: "relay" or "netem".
            direction: "uplink" or "downlink".
            mode: What was asked for: "auto", "relay" or "netem".
        """
        assert self._live.link is not None, "only a link is shaped"
        self._live.link.shaped(shaper, direction, mode)

    def asked(self, direction: str, delay: float) -> None:
        """Say which mean delay [s] the profile in force asks for; only with the role "link"."""
        assert self._live.link is not None, "only a link is shaped"
        self._live.link.asked(direction, delay)

    def unresolved(self, count: int) -> None:
        """Say how often the peer's name could not be resolved so far, from any thread."""
        self._live.see([Counted(0, "link", "unresolved", count)])

    def recording(self, sync_age: Callable[[], float | None]) -> None:
        """Say who knows how old the recording on the disk is [s]; None while there is none."""
        self._sync_age = sync_age

    def tells(self, tell: Callable[[], str]) -> None:
        """Answer /link.json with this JSON from now on; only with the role "link"."""
        assert self._live.link is not None, "an end tells of its check"
        self._live.link.tell = tell

    @property
    def is_ready(self) -> bool:
        """Whether this process has said so, or as an end of the tunnel hears the other end."""
        return self._said_ready or (self._live.end is not None and self._live.end.has_peer)

    def serve(self, address: str | tuple[str, int]) -> int:
        """Begin to answer on HOST:PORT.

        Returns:
            The port: the kernel's choice where 0 was asked for.

        Raises:
            MissingPrerequisiteError: If the address cannot be had.
        """
        if isinstance(address, str):
            host, _, port = address.rpartition(":")
            address = host, int(port)
        pages = {"/metrics": self._page, "/healthz": self._liveness, "/readyz": self._readiness}
        end, link = self._live.end, self._live.link
        if end is not None:
            pages["/link.json"] = lambda: Answer(200, end.check.text().encode(), JSON)
        if link is not None:
            pages["/link.json"] = lambda: Answer(200, link.tell().encode(), JSON)
        self._server = ProbeServer(address, pages)
        return int(self._server.server_address[1])

    def close(self) -> None:
        """Stop answering."""
        if self._server is not None:
            self._server.close()
            self._server = None

    def collect(self) -> Iterator[Family]:
        """Give everything known now, as the registry asks for it."""
        readings = self._live.read() | self._of_process()
        for metric in self._metrics:
            reading = readings.get(metric.name)
            if reading:
                yield _family(metric, reading)

    def _of_process(self) -> Readings:
        readings: Readings = {
            "cloudrc_build_info": {(__version__, self._role, self._config): 1.0},
            "cloudrc_ready": plain(self.is_ready),
        }
        if (age := self._sync_age()) is not None:
            readings["cloudrc_recorder_sync_age_seconds"] = plain(age)
        throttling = read_throttling()
        if throttling is not None:
            readings["cloudrc_cpu_periods_total"] = plain(throttling.periods)
            readings["cloudrc_cpu_throttled_periods_total"] = plain(throttling.throttled)
            readings["cloudrc_cpu_throttled_seconds_total"] = plain(throttling.seconds)
        return readings

    def text(self) -> str:
        """Write what Prometheus scrapes."""
        return generate_latest(self._registry).decode()

    def _page(self) -> Answer:
        """Tell what `text` said at most `KEPT` ago; who asks while it is made waits for it."""
        with self._making:
            now = time.monotonic()
            if now - self._made_at >= KEPT:
                self._made_at = now
                self._made = Answer(200, self.text().encode(), TEXT_FORMAT)
            return self._made

    def _readiness(self) -> Answer:
        return Answer(200, b"ready\n") if self.is_ready else Answer(503, b"no peer yet\n")

    def _liveness(self) -> Answer:
        """Whether this process' own loop moves; the link and the other end are no part of it."""
        still = None if self._seen_at is None else time.monotonic() - self._seen_at
        if still is None or still <= STILL_MAX:
            return Answer(200, b"alive\n")
        return Answer(503, f"the loop has stood still for {still:.0f} s\n".encode())


def _family(metric: Metric, reading: dict[Labels, float] | Histogram) -> Family:
    """Put a reading into the library's words."""
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
