# SPDX-License-Identifier: Apache-2.0

"""Build the parts of a flight from an experiment, and convert its values to SI units.

World and cloud do not import each other. What runs them uses them only through
`wire.endpoint.Endpoint`.
"""
