# SPDX-License-Identifier: Apache-2.0

"""Questions that many flights or episodes answer: sweep, compare, margin, eval, rank, exercise."""
