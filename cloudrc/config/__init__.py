# SPDX-License-Identifier: Apache-2.0

"""Read and check configuration files, fill in defaults, and return an immutable experiment."""
