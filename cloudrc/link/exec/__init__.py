# SPDX-License-Identifier: Apache-2.0

"""Shape the network between two programs: each has a network namespace with one TUN device.

    client > [TUN]  TunRelay  [TUN] > server

The relay reads every IP packet that a program sends, and hands it to the other namespace when the
link's model says so. A namespace belongs to a process, the holder, and ends with it.
"""
