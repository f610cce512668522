# SPDX-License-Identifier: Apache-2.0

"""Keep rows in a bucket of S3, or of a store with the same API, such as MinIO.

Address and credentials of the store come from the variables of the AWS tools, such as
`AWS_ENDPOINT_URL` and `AWS_ACCESS_KEY_ID`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cloudrc.base.errors import MissingPrerequisiteError, describe_error
from cloudrc.base.requirements import require
from cloudrc.flight.trials.rows import Row, Rows, line_of, take_lines

SCHEME = "s3://"
PART = 100
"""Number of rows in an object. An object cannot grow, so each row writes its object again."""


class BucketRows(Rows):
    """The rows in the objects of a folder of a bucket; each pod writes objects of its own."""

    def __init__(self, folder: str, name: str) -> None:
        """Read the rows in `folder`, such as s3://lab/sweeps/one; `name` is that of this pod."""
        super().__init__()
        require("a bucket", ("bucket",))
        from s3fs import S3FileSystem

        self._folder, self._name = folder.rstrip("/"), name
        self._lines = list[bytes]()
        with self._errors():
            self._store = S3FileSystem(use_listings_cache=False, skip_instance_cache=True)
            paths = self._store.glob(f"{self._folder}/rows*.jsonl")
            for path, data in sorted(self._store.cat(paths).items()) if paths else ():
                take_lines(data, f"{SCHEME}{path}", self.kept)

    def _write(self, row: Row) -> None:
        self._lines.append(line_of(row))
        part = (len(self._lines) - 1) // PART
        path = f"{self._folder}/rows-{self._name}-{part}.jsonl"
        with self._errors():
            self._store.pipe_file(path, b"".join(self._lines[part * PART :]))

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Let an error of the store name the folder, and what to check."""
        from botocore.exceptions import BotoCoreError

        try:
            yield
        except (BotoCoreError, OSError) as error:
            text = f"{self._folder}: {describe_error(error)}"
            raise MissingPrerequisiteError(
                f"{text}; check the bucket, and the variables AWS_* of the pods"
            ) from error


def open_rows(place: str | None, name: str) -> Rows:
    """Open the rows in a folder, or in a folder of a bucket; None: keep them in memory alone."""
    if place is None or place.startswith(SCHEME):
        return BucketRows(place, name) if place else Rows()
    folder = Path(place)
    folder.mkdir(parents=True, exist_ok=True)
    return Rows(folder, name)
