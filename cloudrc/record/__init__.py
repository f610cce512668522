"""Record flights in MCAP files, and read the files as arrays.

Only the modules `ros`, `writer` and `reader` need the packages of `cloudrc[record]`.
"""

from __future__ import annotations

from cloudrc.errors import MissingPrerequisiteError


def missing(error: ImportError) -> MissingPrerequisiteError:
    """Make an error that names a missing package and the command to install it."""
    name = (error.name or str(error)).partition(".")[0]
    return MissingPrerequisiteError(
        f"recording needs the package {name}, which is not installed;"
        " install it with: pip install 'cloudrc[record]'"
    )
