# SPDX-License-Identifier: Apache-2.0

"""Links on their own: between programs and streams, under test, drawn, recorded, and changed."""
