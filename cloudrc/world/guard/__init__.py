# SPDX-License-Identifier: Apache-2.0

"""The onboard guard: it keeps the robot safe, whatever the cloud sends."""
