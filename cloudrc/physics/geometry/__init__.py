# SPDX-License-Identifier: Apache-2.0

"""Geometry of scene and robot; needs no physics engine."""
