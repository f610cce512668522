# SPDX-License-Identifier: Apache-2.0

"""A release of the chart on Kubernetes: install it, fly missions, fetch recordings."""

DEFAULT_RELEASE = "cloudrc"
"""Name of a Helm release that nobody has named."""
