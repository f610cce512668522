# SPDX-License-Identifier: Apache-2.0

"""Run the endpoints, world and cloud. Endpoints themselves use no clocks, sockets or threads.

Drivers call endpoints only through the interface in `cloudrc/wire/endpoint.py`.
"""
