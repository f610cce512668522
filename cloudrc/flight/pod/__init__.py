# SPDX-License-Identifier: Apache-2.0

"""One process of a flight in real time: an end, teleop, a link or a cell.

`flight/local/` starts them here, a pod in a cluster.
"""
