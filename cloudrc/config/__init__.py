# SPDX-License-Identifier: Apache-2.0

"""What is asked: configuration files, checked and completed to an immutable experiment."""
