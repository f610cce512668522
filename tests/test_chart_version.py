# SPDX-License-Identifier: Apache-2.0

"""A change of the chart needs a version of its own."""

import subprocess

from tools.chart_version import CHART, is_refused


def test_a_changed_chart_needs_a_higher_version(tmp_path):
    def git(*words):
        name = ("-c", "user.name=me", "-c", "user.email=me@example.org")
        subprocess.run(["git", "-C", tmp_path, *name, *words], check=True, capture_output=True)

    chart = tmp_path / CHART
    chart.mkdir(parents=True)
    (chart / "Chart.yaml").write_text("version: 0.9.0\n")
    git("init")
    git("add", ".")
    git("commit", "--message=one")
    assert not is_refused(tmp_path, "HEAD")
    (chart / "values.yaml").write_text("a: 1\n")
    git("add", ".")
    assert is_refused(tmp_path, "HEAD")
    (chart / "Chart.yaml").write_text("version: 0.10.0\n")
    assert not is_refused(tmp_path, "HEAD")
