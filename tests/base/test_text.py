# SPDX-License-Identifier: Apache-2.0

"""Tables for papers and programs keep each value."""

import csv

from cloudrc.base.text import cells, csv_table, latex_table, table, unknown_name_text

ROWS = [
    ("round trip", "95 %", "x_y", "note"),
    ("no network", "83-100 %", "-1.2 .. -3", "a & b"),
    ("time-indexed", "0-17 %", "-", "{}#$"),
]


def test_a_table_has_columns_in_line_also_with_wide_characters_and_escapes_those_that_move():
    rows = [("name", "n", "note"), ("東京", "12", ""), ("a\x1b", "3 ", "été")]
    assert table(rows, right=[1]).split("\n") == [
        "name    n  note",
        "東京   12",
        r"a\x1b   3  été",
    ]
    assert table([]) == ""


def test_a_table_of_latex_has_minus_signs_and_no_bare_special_character():
    assert latex_table(ROWS).splitlines() == [
        r"\begin{tabular}{lrrr}  % \usepackage{booktabs}",
        r"\toprule",
        r"round trip & 95 \% & x\_y & note \\",
        r"\midrule",
        r"no network & 83-100 \% & $-$1.2 to $-$3 & a \& b \\",
        r"time-indexed & 0-17 \% & - & \{\}\#\$ \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_a_table_of_csv_has_a_column_for_each_value_that_a_row_has():
    rows = [{"name": 'a,"b"', "low": 0.1}, {"name": "c", "low": None, "failed": 0}]
    assert list(csv.DictReader(csv_table(rows).splitlines())) == [
        {"name": 'a,"b"', "low": "0.1", "failed": ""},
        {"name": "c", "low": "", "failed": "0"},
    ]
    assert csv_table([]) == ""


def test_a_cell_without_a_value_is_a_dash_and_a_column_of_them_is_left_out():
    rows = [{"age": 1.5, "a": 1}, {"age": None, "a": 2, "b": {"p": 0.25}}]
    columns = {"age": "{age:.0f} ms", "a, b": "{a}/{b[p]:.1g}", "late": "{late:.0%}"}
    assert cells(rows, columns) == [("age", "a, b"), ("2 ms", "-"), ("-", "2/0.2")]


def test_of_many_known_names_an_error_lists_the_similar_ones():
    many = [*map(str, range(1000, 1100)), "frame_age_p99", "frame_age_max"]
    near = "similar: frame_age_p99, frame_age_max; did you mean frame_age_p99?"
    assert unknown_name_text("number", "frame_age_p9", many).endswith(f"'frame_age_p9'; {near}")
    assert unknown_name_text("number", "blur", many).endswith(f"available: {', '.join(many)}")
    few = unknown_name_text("codec", "jpg", ["jpeg", "h264"])
    assert few == "no codec named 'jpg'; available: jpeg, h264; did you mean jpeg?"
