# SPDX-License-Identifier: Apache-2.0

"""The exporter: valid text in bounds, probes on one port, hostile clients, CPU throttling."""

import select
import socket

import pytest
from prometheus_client.parser import text_string_to_metric_families

from cloudrc.config.load import load_experiment
from cloudrc.flight.pod import exporter as exporters
from cloudrc.flight.pod.exporter import Exporter, read_throttling
from cloudrc.link.carry.log import ReleaseErrors
from cloudrc.link.cell import Usage
from cloudrc.results.exposition.table import (
    ENDS,
    LINK_OUTCOMES,
    METRICS,
    ROLES,
    MetricKind,
    of_role,
)
from cloudrc.wire.messages import ZERO
from cloudrc.wire.records import (
    Contact,
    Control,
    Counted,
    Lateness,
    LinkChecked,
    MissionEvent,
    TelemetrySent,
)
from tests.flights.conftest import records
from tests.support.http import DIRECT, ask

HOST = "127.0.0.1"


@pytest.fixture(scope="module")
def flight():
    """The records of a flight with real-time wakes, and those of the other roles."""
    both = records(load_experiment("hover", ["link.profile=paper-p3"]))
    seen = {end: [*of_end] for end, of_end in zip(ENDS, both, strict=True)}
    for end, uplink in zip(ENDS, (False, True), strict=True):
        stamps = [r.stamp_ns for r in seen[end] if isinstance(r, TelemetrySent | Control)]
        seen[end] += [Lateness(stamp_ns, end, 80e-6, 300e-6, 0) for stamp_ns in stamps]
        seen[end] += [
            LinkChecked(9, uplink, name, 0.1, 0.1, 0.0, 0.2, "ok", 3000)
            for name in ("mean", "deviation", "loss")
        ]
    seen["world"] += [Contact(0, body, ZERO, ZERO, ZERO, True) for body in ("floor", "board")]
    seen["teleop"] = [r for r in seen["cloud"] if isinstance(r, MissionEvent)]
    (errors := ReleaseErrors()).observe(3_000)
    counts = dict.fromkeys(LINK_OUTCOMES, 5) | errors.in_ns() | {"restored": 1}
    counts |= {"step_lateness_p50_ns": 1_000_000, "step_lateness_p99_ns": 1_000_000}
    seen["link"] = [Counted(0, "link", name, total) for name, total in counts.items()]
    return seen


def exporter(role, flight):
    made = Exporter(role)
    made.see(flight.get(role, ()))
    if role in ENDS:
        made.sync_age = lambda: 0.3
    if role == "link":
        made.link.shaped("netem", "uplink", "auto", 0.045)
        made.link.shaped("relay", "uplink", "auto", 0.045)  # takes the place of netem
    if role == "cell":
        made.cell.expect(8)
        made.cell.take([Usage("both", 0.1, 2, 250, 50_000_000, 4_000_000, dropped={7: 1, -1: 9})])
    return made


@pytest.mark.parametrize("role", ROLES)
def test_a_flight_shows_the_metrics_of_its_role(role, flight):
    text = exporter(role, flight).text()
    found, optional = set(), {name for name in METRICS if "_cpu_" in name}  # the kernel may count
    optional.add("cloudrc_camera_seconds")  # without pictures there is none
    for family in text_string_to_metric_families(text):
        found.add(family.name + "_total" * (family.type == "counter"))
        for sample in family.samples:
            metric = METRICS.get(sample.name)
            if metric is not None and metric.kind is not MetricKind.HISTOGRAM:
                assert set(sample.labels) == set(metric.labels)
    expected = {metric.name for metric in of_role(role)}
    own = {name for name in found if not name.startswith("process_")}
    assert own | optional == expected | optional
    assert "_created" not in text
    assert text.count("cloudrc_link_info{") == (role == "link")


@pytest.mark.parametrize("pod", [("world", "link"), ("cloud", "teleop", "link")])
def test_a_pod_has_less_than_200_series(pod, flight):
    texts = [exporter(role, flight).text() for role in pod]
    assert sum(not line.startswith("#") for text in texts for line in text.splitlines()) < 200


LIMITED = "nr_periods 120\nnr_throttled 17\nthrottled_usec 1250000\n"


@pytest.mark.parametrize(
    ("text", "counts"),
    [
        (LIMITED, [120, 17, 1.25]),
        ("usage_usec 4402130\n", []),  # without a limit
    ],
)
def test_throttling_is_read_from_the_kernel(text, counts, tmp_path):
    (tmp_path / "cpu.stat").write_text(text)
    read = read_throttling(tmp_path)
    values = [value for reading in read.values() for value in dict(reading).values()]
    assert values == pytest.approx(counts)


@pytest.fixture
def served():
    exporter = Exporter("link")
    port = exporter.serve((HOST, 0))
    yield exporter, port
    exporter.close()


def get(port, path):
    return ask(f"http://{HOST}:{port}{path}")


def test_metrics_and_probes_are_on_one_port(served):
    exporter, port = served
    assert get(port, "/healthz") == (200, "alive\n")
    assert get(port, "/readyz") == (503, "no peer yet\n")
    for ready, status in ((True, 200), (False, 503)):
        exporter.ready(ready)
        assert get(port, "/readyz")[0] == status
        assert f"cloudrc_ready {ready:.1f}" in get(port, "/metrics?name=any")[1]
    with DIRECT.open(f"http://{HOST}:{port}/metrics", timeout=10) as answer:
        assert answer.headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
    assert get(port, "/") == (404, "there are /metrics, /healthz, /readyz, /link.json\n")


def test_a_loop_that_stands_still_is_not_alive(served):
    """Liveness does not depend on the other end, nor on the loop before its start."""
    exporter, port = served
    exporter.unresolved(7)  # another thread than the loop's calls this
    assert exporter._seen_at is None
    exporter.see([])
    assert get(port, "/healthz") == (200, "alive\n")
    exporter._seen_at -= 61.0
    assert get(port, "/healthz") == (503, "the loop has stood still for 61 s\n")


@pytest.mark.fault(
    31,
    "slow-scrapers",
    injects="clients open requests for metrics and hold them",
    expects="a probe is answered; the oldest connections are closed",
    figures="200 open requests; answer within .9 s",
)
def test_a_burst_of_clients_that_hang_blocks_no_probe(served):
    """The oldest are closed."""
    waiting = [socket.create_connection((HOST, served[1]), timeout=0.9) for _ in range(200)]
    waiting[-1].sendall(b"GET /metr")
    assert get(served[1], "/healthz")[0] == 200
    closed = select.select(waiting, [], [], 0)[0]
    assert closed == waiting[: len(closed)]
    assert len(closed) == len(waiting) + 1 - exporters.CONNECTIONS_MAX
    for client in waiting:
        client.close()
