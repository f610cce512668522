"""Record flights in MCAP files and read them back as arrays.

`topics` defines the topics, `hash` identifies a run, `recorder` and `writer` write files, `reader`
and `columns` read files, `recover` repairs files, `merge` puts the recordings of both ends on one
clock. Only `ros`, `writer`, `reader` and `recover` import the packages that `cloudrc[record]`
installs.
"""

from __future__ import annotations

from cloudrc.errors import MissingPrerequisiteError


def missing(error: ImportError) -> MissingPrerequisiteError:
    """Make an error that names a missing package and the command that installs the package.

    Args:
        error: Error of the import.

    Returns:
        The error to raise instead.
    """
    name = (error.name or str(error)).partition(".")[0]
    return MissingPrerequisiteError(
        f"recording needs the package {name}, which is not installed;"
        " install it with: pip install 'cloudrc[record]'"
    )
