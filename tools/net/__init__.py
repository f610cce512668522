# SPDX-License-Identifier: Apache-2.0

"""The net: facts of flights, studies and texts, kept before a change and compared after it.

    python -m tools.net --write before.json     # on the commit before
    python -m tools.net --compare before.json   # on the changed tree; exit 1 if anything differs

It has three parts: `flights`, `numbers` and `texts`; `--part` chooses one.
"""
