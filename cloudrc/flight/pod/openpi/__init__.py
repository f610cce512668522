# SPDX-License-Identifier: Apache-2.0

"""The wire of openpi's policies: observations up, chunks of actions down, over a WebSocket.

The server speaks first: one map, its metadata. Then the client sends an observation and the server
answers with actions, in turns. Each message is a binary frame with one msgpack map. An error is a
text frame, after which the server closes the connection.
"""

KEY_VARIABLE = "CLOUDRC_POLICY_KEY"
"""Environment variable with the API key of a policy's server, for the server and for clients."""
