"""Exposition: records of a flight come in, what Prometheus scrapes comes out, without I/O.

`table` says which metrics there are; code, documentation, dashboards and tests read it. `live`
keeps their values, fed with the records of one process; `cloudrc.drivers.exporter` serves them.
"""
