# SPDX-License-Identifier: Apache-2.0

"""The robots that ship with cloudrc: a folder each, with model, controller and actuators."""
