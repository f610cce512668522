# SPDX-License-Identifier: Apache-2.0

"""Policies of users: load them, serve them over the wire of `flight.pod.openpi`."""
