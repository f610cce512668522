# SPDX-License-Identifier: Apache-2.0

"""A flight in real time on this machine: a supervisor, and what it starts and ends."""
