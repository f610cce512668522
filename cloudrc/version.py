# SPDX-License-Identifier: Apache-2.0

"""The version of cloudrc; `cloudrc.__version__` is the public name."""

__version__ = "0.1.0"
