# SPDX-License-Identifier: Apache-2.0

"""What a flight leaves: recordings, numbers, verdicts, reports, live metrics."""
