"""The table of metrics as a page: it comes in, docs/metrics.md goes out (`make docs`)."""

from __future__ import annotations

from collections.abc import Iterable

from cloudrc.exposition.table import METRICS, ROLES, Metric

HEAD = """\
# Metrics

<!-- Written by `make docs` from cloudrc/exposition/table.py: edit that. -->

Every process serves `/metrics` for Prometheus, `/healthz` (200 while its own loop has moved in the
last 5 s) and `/readyz` (200 once it hears its peer) where `--metrics HOST:PORT` says; in the
cluster that is port 9100 of `world` and `cloud`, 9101 of `teleop` and 9102 of `link`. All values
are in base units, all labels have closed sets of values but for the two of `cloudrc_build_info`
that name a version and a configuration, and a value that cannot be known is absent, never zero.
A page is made at most four times a second, whoever asks, and is at most 0.25 s old. Beside these
there are the usual `process_*` metrics: CPU, memory, file descriptors.
"""

QUERIES = {
    "Round trip, 95th percentile": (
        "histogram_quantile(0.95, sum by (le) (rate(cloudrc_rtt_seconds_bucket[1m])))"
    ),
    "Mean uplink delay; downlink likewise": (
        "rate(cloudrc_uplink_delay_seconds_sum[1m]) / rate(cloudrc_uplink_delay_seconds_count[1m])"
    ),
    "Loss by direction": (
        "rate(cloudrc_datagrams_lost_total[1m]) / rate(cloudrc_datagrams_expected_total[1m])"
    ),
    "Prediction error, RMS [m]": (
        "sqrt(rate(cloudrc_prediction_error_square_meters_total[1m])"
        " / rate(cloudrc_predictions_judged_total[1m]))"
    ),
    "PID terms of one axis": 'cloudrc_pid_output{axis="x"}',
    "Share of the time stopped by a CPU limit": (
        "rate(cloudrc_cpu_throttled_seconds_total[1m])"
        " * on (instance) group_left (role) cloudrc_build_info"
    ),
    "Wakes later than 1 ms, as a share": (
        '1 - sum by (instance) (rate(cloudrc_loop_lateness_seconds_bucket{le="0.001"}[1m]))'
        " / sum by (instance) (rate(cloudrc_loop_lateness_seconds_count[1m]))"
    ),
    "Processes by configuration; a release has one, link containers none": (
        "count by (config) (cloudrc_build_info)"
    ),
    "World slower than real time": "cloudrc_real_time_factor < 0.95",
}
OPEN = {
    "version": "the version",
    "config": "the first 12 digits of the SHA-256 of the configuration that the process was given, "
    "its defaults written out, those of plug-ins left open (a run on one machine gives all: of it "
    "`config_sha256` in report.json has the same digits); empty where a process has none",
}
"""What is said of labels whose values are not listed."""


def page() -> str:
    """Write the whole page, in Markdown."""
    blocks = [HEAD, "## Queries\n"]
    blocks += [f"{title}:\n\n```promql\n{query}\n```\n" for title, query in QUERIES.items()]
    blocks += ["## All metrics\n", _table(METRICS.values())]
    blocks += ["## Buckets\n", _buckets(METRICS.values())]
    return "\n".join(blocks)


def _table(metrics: Iterable[Metric]) -> str:
    rows = ["| metric | type | from | meaning |", "| --- | --- | --- | --- |"]
    for metric in metrics:
        where = "all" if metric.roles == ROLES else ", ".join(metric.roles)
        cells = (f"`{metric.name}`", metric.kind.value, where, metric.meaning + _labels(metric))
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def _labels(metric: Metric) -> str:
    """Name the labels with their values."""
    sets = [
        f"`{label}`: {', '.join(values) or OPEN[label]}" for label, values in metric.labels.items()
    ]
    return f" Labels: {'; '.join(sets)}." if sets else ""


def _buckets(metrics: Iterable[Metric]) -> str:
    lines = [
        f"- `{metric.name}`: {', '.join(f'{bound:g}' for bound in metric.buckets)}"
        for metric in metrics
        if metric.buckets
    ]
    return "\n".join(lines) + "\n"
