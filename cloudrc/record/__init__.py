"""Record flights in MCAP files and read them back as arrays.

Only `ros`, `writer` and `reader` import the packages that `cloudrc[record]` installs.
"""

from __future__ import annotations

from cloudrc.errors import MissingPrerequisiteError


def missing(error: ImportError) -> MissingPrerequisiteError:
    """Make an error that names a missing package and the command that installs the package."""
    name = (error.name or str(error)).partition(".")[0]
    return MissingPrerequisiteError(
        f"recording needs the package {name}, which is not installed;"
        " install it with: pip install 'cloudrc[record]'"
    )
