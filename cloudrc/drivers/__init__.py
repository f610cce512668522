"""Run the endpoints: only drivers own the control loop's clocks, sockets and threads.

Drivers know only the contract of endpoints in `cloudrc/endpoint.py`.
"""
