# SPDX-License-Identifier: Apache-2.0

"""Texts that are kept in files."""


def compare(path, text):
    """Compare a text with its file. Without a file it is written: to renew it, delete it."""
    if not path.exists():
        path.write_text(text)
    assert text == path.read_text()
