# SPDX-License-Identifier: Apache-2.0

"""Build a flight and run it: virtual or real time, one or many."""
