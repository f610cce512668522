# SPDX-License-Identifier: Apache-2.0

"""Measure whether a policy survives a network: episodes of any environment of gymnasium."""
