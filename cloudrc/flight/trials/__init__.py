# SPDX-License-Identifier: Apache-2.0

"""Trials: conditions x seeds are planned, played in processes, kept as rows and summarised."""
