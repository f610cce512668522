"""Recording: records go in; a hash, MCAP files and columns of numbers come out.

`topics` says what is recorded, `hash` identifies a run, `recorder` and `writer` keep it,
`columns` reads it back, `merge` puts both ends on one clock. What `cloudrc[record]` installs is
imported only by `ros_types`, `writer` and `reader`.

The packages that recording needs and flying does not: an import error goes in, advice out.
"""

from __future__ import annotations

from cloudrc.errors import MissingPrerequisiteError


def missing(error: ImportError) -> MissingPrerequisiteError:
    """Say which package is missing and what installs it.

    Args:
        error: What importing it raised.

    Returns:
        The error to raise in its place.
    """
    name = (error.name or str(error)).partition(".")[0]
    return MissingPrerequisiteError(
        f"recording needs the package {name}, which is not installed;"
        " install it with: pip install 'cloudrc[record]'"
    )
