# SPDX-License-Identifier: Apache-2.0

"""Onboard controllers that fly or drive any robot of their kind."""
