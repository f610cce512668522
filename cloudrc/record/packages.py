"""The packages that recording needs and flying does not: an import error goes in, advice out."""

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
