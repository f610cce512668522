# SPDX-License-Identifier: Apache-2.0

"""Runs: fly experiments, sweep settings, compare and measure them, from commands and programs."""
