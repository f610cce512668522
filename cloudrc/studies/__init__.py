# SPDX-License-Identifier: Apache-2.0

"""Studies with trials: sweep, compare, margin, identify."""
