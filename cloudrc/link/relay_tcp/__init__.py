"""Carry TCP connections over the emulated link without privileges.

    client > TCP > StreamRelay > TCP > server

The relay ends both connections, and hands bytes on as a TCP over the link would: `medium.py` is the
link, `stream.py` one direction of a connection over it, `relay.py` has the sockets.
"""
