"""Prometheus metrics of a process, computed from its records, without I/O.

`table` defines all metrics; code, documentation, dashboards and tests read this table. `live` keeps
the current values, which `cloudrc.drivers.exporter` serves.
"""
