# SPDX-License-Identifier: Apache-2.0

"""A flight in virtual time: one process runs world, cloud and the link, on a clock of its own."""
