# SPDX-License-Identifier: Apache-2.0

"""The quadrotor of the paper: AscTec Pelican class, with a rigid arm."""
