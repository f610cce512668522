# SPDX-License-Identifier: Apache-2.0

"""Compute the metrics of a recorded flight; each metric is one number with a unit.

`measure` finds and computes metrics; `descriptions` has names, units and meanings of the metrics of
cloudrc, and the functions that measure are in `flight`, `control`, `link`, `mission` and
`response`. `definitions` has the quantities that live metrics, console and
report share. docs/plugins-metric.md explains how to add your own metrics.
"""
