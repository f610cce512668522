# SPDX-License-Identifier: Apache-2.0

"""Bridges connect cloudrc with the networks of other systems."""
