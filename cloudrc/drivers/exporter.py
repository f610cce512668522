"""The metrics of a process: fed with its records like the recorder, scraped by Prometheus.

    exporter = Exporter("world")
    exporter.serve("127.0.0.1:9100")    /metrics, /healthz and /readyz, on threads of their own
    exporter.see(records)               on the loop's thread: less than 1 us per record
    exporter.ready(True)                a process that is no end of the tunnel says when it is

What `see` takes in is kept in plain numbers; Prometheus' text is made of them when it is scraped,
at most four times a second.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from math import inf

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily
from prometheus_client.metrics_core import Metric as Family

from cloudrc import __version__
from cloudrc.drivers.cgroup import read_throttling
from cloudrc.drivers.probes import Answer, ProbeServer
from cloudrc.exposition.live import Live
from cloudrc.exposition.parts import Histogram, Readings, plain
from cloudrc.exposition.table import Kind, Labels, Metric, of_role
from cloudrc.records import Counted, Record

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
