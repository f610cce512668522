"""A number beyond its limit fails its test; the nightly page shows its worst measurement."""

import json

import pytest

from tools import evidence


def test_the_nightly_page_shows_the_worst_of_each_number(figure, tmp_path, monkeypatch):
    monkeypatch.setenv("CLOUDRC_EVIDENCE", str(tmp_path))
    figure("clearance", 0.2, ">=", 0.12, "m", count=10)
    figure("clearance", 0.13, ">=", 0.12, "m", count=20)
    for measured, said in ((None, "nan"), (0.253, "0.253")):
        with pytest.raises(AssertionError, match=f"HOLD after: {said} s, asked <= 0.252 s"):
            figure("HOLD after", measured, "<=", 0.252, "s")
    figure("HOLD after", 0.25, "<=", 0.252, "s")
    evidence.write(tmp_path)
    lines = (tmp_path / "index.md").read_text().splitlines()
    assert "| HOLD after | <= 0.252 s | - | 3 | tests/test_evidence.py |" in lines
    assert "| clearance | >= 0.12 m | 0.13 m | 30 | tests/test_evidence.py |" in lines
    written = json.loads((tmp_path / "numbers.json").read_text())["numbers"]
    assert [(row["name"], row["measured"]) for row in written] == [
        ("HOLD after", None),
        ("clearance", 0.13),
    ]


def test_the_nightly_page_shows_all_kinds_of_results(tmp_path, call):
    files = {
        "search-adversarial.json": "",  # its command failed
        "tests.xml": '<testsuite tests="9" failures="1" errors="0" skipped="2"/>',
        "mutants.txt": "  a.x_b__mutmut_1: killed\n  a.x_b__mutmut_2: survived\n",
    }
    for name, words in (("faults", "run F17"), ("search-random", "search --minutes 0.001")):
        files[f"{name}.json"] = call(f"faults {words} -o json").out
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    evidence.write(tmp_path)
    page = (tmp_path / "index.md").read_text()
    assert "| F17 | world-restarted | passed |" in page
    assert "## Search: random" in page
    assert "| fence breaches | 0 | 1 | p < 1 |" in page
    assert "| tests | 9 | 1 | 0 | 2 |" in page
    assert "| survived | 1 |" in page
