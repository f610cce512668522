# SPDX-License-Identifier: Apache-2.0

"""Compute the Prometheus metrics of a process from its records.

`table` defines all metrics for code, documentation, dashboards and tests. `live` computes the
current values; `cloudrc.flight.pod.exporter` serves them over HTTP.
"""
