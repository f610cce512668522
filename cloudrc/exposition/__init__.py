"""Exposition: Prometheus metrics of a process, computed from its records, without I/O.

`table` defines all metrics; code, documentation, dashboards and tests read it. `live` keeps their
current values. `cloudrc.drivers.exporter` serves them.
"""
