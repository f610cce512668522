# SPDX-License-Identifier: Apache-2.0

"""Compute the metrics of a recorded flight; each metric is one number with a unit.

`measure` finds and computes metrics; the metrics of cloudrc are rows of tables in `flight`,
`control`, `link` and `mission`. `definitions` has the quantities that live metrics, console and
report share. docs/plugins-metric.md explains how to add your own metrics.
"""
