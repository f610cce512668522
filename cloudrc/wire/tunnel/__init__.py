# SPDX-License-Identifier: Apache-2.0

"""The authenticated UDP tunnel between world and cloud."""
