# SPDX-License-Identifier: Apache-2.0

"""What comes from outside: numbers, documents and code of users; imports nothing of cloudrc.

Doors (flags, files, the Python API) read with it, and give typed values to the rooms behind them.
"""
