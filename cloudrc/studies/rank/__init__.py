# SPDX-License-Identifier: Apache-2.0

"""Rank policies over networks: the same tasks, links, seeds and scorer for everybody."""
