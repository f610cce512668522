"""Where the Helm chart is: in an installed wheel, or in the repository beside the package."""

from __future__ import annotations

from pathlib import Path

from cloudrc.errors import MissingPrerequisiteError

PACKAGE = Path(__file__).resolve().parents[1]
CHART_FILE = "Chart.yaml"


def chart_folder(package: Path = PACKAGE) -> Path:
    """Find the chart.

    Args:
        package: The folder `cloudrc`, wherever it is installed.

    Raises:
        MissingPrerequisiteError: If it is in neither place.
    """
    # A wheel carries the chart inside the package; an editable install leaves it where it is.
    places = (package / "_chart", package.parent / "charts" / "cloudrc")
    for place in places:
        if (place / CHART_FILE).is_file():
            return place
    raise MissingPrerequisiteError(
        f"the Helm chart is in neither of {places[0]} and {places[1]}; install cloudrc again: "
        "pip install --force-reinstall cloudrc"
    )
