# SPDX-License-Identifier: Apache-2.0

"""A file has the same bytes as one that the package mcap writes."""

from io import BytesIO
from random import Random

import pytest
from mcap.writer import CompressionType, IndexType, Writer

from cloudrc.results.record.mcap_file import McapFile

NO_INDEX = IndexType.ATTACHMENT | IndexType.METADATA


@pytest.mark.parametrize("index", [True, False])
@pytest.mark.parametrize("size", [0, 40, 30_000])
def test_the_bytes_are_those_of_mcap(index, size):
    """Times go back, chunks end by their size and by `flush`, and some channels stay empty."""
    ours, theirs, rng = BytesIO(), BytesIO(), Random(1)
    file = McapFile(ours, "test", index=index)
    types = IndexType.ALL if index else NO_INDEX
    mcap = Writer(
        theirs, compression=CompressionType.ZSTD, enable_data_crcs=True, index_types=types
    )
    mcap.start("ros2", "test")
    for name in ("a", "b"):
        schema = file.add_schema(name, "ros2msg", b"text")
        assert mcap.register_schema(name, "ros2msg", b"text") == schema
        channel = file.add_channel(f"/{name}", "cdr", schema, {"key": name})
        assert mcap.register_channel(f"/{name}", "cdr", schema, {"key": name}) == channel
    for number in range(150 if size else 0):
        now_ns, channel = rng.randrange(100, 10**9), 1 + (number > 60)
        data = rng.randbytes(rng.randrange(size))
        file.add_message(channel, number, now_ns, data)
        mcap.add_message(channel, now_ns, data, now_ns, number)
        if number % 40 == 0:
            file.flush()
            mcap.flush()
            file.add_metadata("note", {"number": str(number)})
            mcap.add_metadata("note", {"number": str(number)})
    file.attach("report", "text/plain", 7, b"text")
    mcap.add_attachment(0, 7, "report", "text/plain", b"text")
    file.finish()
    mcap.finish()
    assert ours.getvalue() == theirs.getvalue()
