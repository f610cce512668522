# SPDX-License-Identifier: Apache-2.0

"""The simulator and its geometry: the one place that knows MuJoCo."""
