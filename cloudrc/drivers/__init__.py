"""Run the endpoints, world and cloud. Only drivers use clocks, sockets and threads for them.

Drivers call endpoints only through the interface in `cloudrc/endpoint.py`.
"""
