"""Run the endpoints: only drivers own the control loop's clocks, sockets and threads.

They know the endpoints by the contract in `cloudrc/endpoint.py` alone.
"""
