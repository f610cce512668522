# SPDX-License-Identifier: Apache-2.0

"""Measure and judge a recorded flight; write a report with numbers, figures and an HTML page."""
