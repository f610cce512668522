# SPDX-License-Identifier: Apache-2.0

"""Carry TCP connections over the emulated link without privileges.

    client > TCP > StreamRelay > TCP > server

The relay ends both connections, and hands their bytes on with the delay, the rate and the repaired
losses of the link: `medium.py` is the link, `stream.py` one direction of a connection over it,
`relay.py` has the sockets. It is no model of a congestion control.
"""
