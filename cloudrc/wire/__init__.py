# SPDX-License-Identifier: Apache-2.0

"""What travels and is recorded: messages, records, the contract of both ends, the tunnel."""
