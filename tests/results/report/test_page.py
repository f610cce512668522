# SPDX-License-Identifier: Apache-2.0

"""The page: one file without network requests, with text, numbers and figures."""

import re
from dataclasses import replace

import pytest

from cloudrc.results.metrics.measure import Number
from cloudrc.results.metrics.verdict import FlightFailure, FlightVerdict
from cloudrc.results.report.document import Run, environment_document
from cloudrc.results.report.figures import FIGURES, Picture
from cloudrc.results.report.page import render
from cloudrc.results.report.summary import readable
from cloudrc.results.report.write import assess, write_report
from tests.results.metrics.conftest import paper


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page of the shipped experiment, with two of its figures."""
    path = tmp_path_factory.mktemp("run")
    experiment, recording = paper()
    with pytest.MonkeyPatch.context() as patch:
        some = {name: FIGURES[name] for name in ("flight", "error")}
        patch.setattr("cloudrc.results.report.figures.FIGURES", some)
        write_report(path, recording, experiment, Run("virtual", "virtual"))
    return (path / "report.html").read_text(encoding="utf-8")


def test_the_page_fetches_nothing_and_describes_every_picture(page):
    pictures = re.findall(r"<img\b[^>]*>", page)
    assert len(pictures) == 3, "two figures, and the still picture of the flight"
    assert all('src="data:image/' in picture for picture in pictures)
    assert all(re.search(r'alt="[^"]{20,}"', picture) for picture in pictures)
    assert all(len(alt) >= 20 for _, _, alt in FIGURES.values())
    page = re.sub('<script type="application/json".*?</script>', "", page, flags=re.DOTALL)
    assert not re.search(r"<(?:link|iframe|object|base|script [^>]*src)\b", page)
    assert not re.search(r"""@import|url\(|(?:href|src|action)\s*=\s*["']?(?:https?:)?//""", page)


def test_the_page_says_what_the_flight_did(page):
    text = re.sub(r"\s", " ", re.sub(r"<[^>]+>", "", page))
    experiment, recording = paper()
    for said in (
        "SUCCESS The mission succeeded.",
        "mission took31.14 s waypoints reached7",
        "first touch at27.87 s",
        "least clearance0.153 m",
        "cloudrc run config.yaml --mode virtual",
        recording.sha256,
        "its axis ends at 0.8 m",
        "says nothing about how accurate the estimate is",
    ):
        assert said in text
    for name, number in assess(recording, experiment, Run("virtual", "virtual")).numbers.items():
        assert f"<code>{name}</code>" in page
        assert number.meaning.split("'")[0] in page


def test_failures_and_notes_are_escaped():
    place = (1.0, -2.0, 0.7)
    failures = (
        FlightFailure("obstacle_touched", "it hit", 3.5, place),
        FlightFailure("x", "<script>alert(1)"),
    )
    assessment = replace(
        assess(*reversed(paper()), Run("local", "relay")),
        verdict=FlightVerdict("failure", failures),
        notes=("metric <b> & 'c'",),
    )
    picture = Picture("delay", {"svg": b"<svg/>"}, "Caption.", 7.16, "A picture of something.")
    page = render(assessment, [picture], environment_document())
    assert '<span class="verdict">FAILURE</span> The mission failed.' in page
    assert "it hit, at 3.50 s, x 1.00, y -2.00, z 0.70 m <code>obstacle_touched</code>" in page
    assert "<script>" not in page
    assert "metric &lt;b&gt; &amp;" in page


@pytest.mark.parametrize(
    ("name", "value", "unit", "expected"),
    [
        ("rtt_mean", 0.069325, "s", ("69.33", "ms")),
        ("min_clearance", 0.15179, "m", ("0.152", "m")),
        ("hold_count", 3.0, "1", ("3", "")),
        ("loss_uplink", 0.0123, "1", ("1.23", "%")),
    ],
)
def test_numbers_have_readable_units(name, value, unit, expected):
    assert readable(name, Number(value, unit, "")) == expected
