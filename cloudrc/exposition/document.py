"""Make docs/metrics.md from the table of metrics (`make docs`)."""

from __future__ import annotations

from collections.abc import Iterable

from cloudrc.exposition.table import METRICS, ROLES, Metric

HEAD = """\
# Metrics

<!-- Written by `make docs` from cloudrc/exposition/table.py: edit that. -->

Every process serves three pages at the address of its option `--metrics HOST:PORT`:

- `/metrics`: the metrics for Prometheus
- `/healthz`: answers 200 if the loop of the process ran in the last 5 s
- `/readyz`: answers 200 while the process hears its peer

In a cluster the ports are 9100 for `world` and `cloud`, 9101 for `teleop` and 9102 for `link`.

All values are in base units (s, m, rad). A value that cannot be known is absent, never zero. Every
label has a closed set of values, except the labels `version` and `config` of `cloudrc_build_info`.
The page `/metrics` is cached for 0.25 s. The page also contains the usual metrics `process_*`: CPU,
memory, file descriptors.
"""

QUERIES = {
    "Round trip, 95th percentile": (
        "histogram_quantile(0.95, sum by (le) (rate(cloudrc_rtt_seconds_bucket[1m])))"
    ),
    "Mean uplink delay (for the downlink, replace `uplink` by `downlink`)": (
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
    "Share of time stopped by the CPU limit": (
        "rate(cloudrc_cpu_throttled_seconds_total[1m])"
        " * on (instance) group_left (role) cloudrc_build_info"
    ),
    "Share of wakes later than 1 ms": (
        '1 - sum by (instance) (rate(cloudrc_loop_lateness_seconds_bucket{le="0.001"}[1m]))'
        " / sum by (instance) (rate(cloudrc_loop_lateness_seconds_count[1m]))"
    ),
    "Processes by configuration (one per release; link containers have none)": (
        "count by (config) (cloudrc_build_info)"
    ),
    "World slower than real time": "cloudrc_real_time_factor < 0.95",
}
OPEN = {
    "version": "the version",
    "config": "the first 12 digits of the SHA-256 of the process's configuration with all "
    "defaults (on one machine with those of plug-ins, as `config_sha256` in report.json; in a "
    "cluster without those of plug-ins); empty for a process without configuration",
}
"""Label with an open set of values -> description of the values."""


def page() -> str:
    """Return the text of docs/metrics.md."""
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
    """Describe the labels of a metric and their values."""
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
