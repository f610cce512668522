# SPDX-License-Identifier: Apache-2.0

"""The robots that ship with cloudrc, each in a folder: its model, its controller, its actuators."""
