# SPDX-License-Identifier: Apache-2.0

"""Carry packets over the emulated link in real time.

    packets > Port  Engine (model, queue, clock)  Port > packets

The engine is the same for datagrams, the packets of a TUN device, the bytes of TCP and the messages
of a topic of ROS 2: their ports differ.
"""
