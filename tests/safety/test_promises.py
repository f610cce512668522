"""Each promise in the docs has an id and a test that carries it; each such test holds a promise."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROMISE = re.compile(r"\[(P-[A-Z]+-\d+)\]")
DOCUMENTS = [
    ROOT / "SECURITY.md",
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    ROOT / "charts" / "cloudrc" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]

FULL = re.compile(r"pytest\.mark\.full\b")


def promised() -> list[str]:
    """Every id that the docs define: in bold at the beginning of a line or of a table's row."""
    text = (ROOT / "docs" / "safety" / "promises.md").read_text(encoding="utf-8")
    return re.findall(r"^\| \[(P-[A-Z]+-\d+)\] \|", text, re.MULTILINE)


def mentioned() -> set[str]:
    return {
        name
        for path in DOCUMENTS
        if path.exists()
        for name in PROMISE.findall(path.read_text(encoding="utf-8"))
    }


def held(source: str) -> list[str]:
    """Ids on the tests of a file, as `@pytest.mark.promise("P-...")` or in its `pytestmark`."""
    return [
        str(node.args[0].value)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call)
        and ast.unparse(node.func) == "pytest.mark.promise"
        and isinstance(node.args[0], ast.Constant)
    ]


def all_held() -> set[str]:
    files = (ROOT / "tests").rglob("test_*.py")
    return {name for path in files for name in held(path.read_text(encoding="utf-8"))}


def test_every_promise_has_a_test() -> None:
    assert sorted(set(promised()) - all_held()) == []


def held_daily(source: str) -> set[str]:
    """Ids on the tests of a file that are more than the full numbers of the night."""
    tree = ast.parse(source)
    tests = [each for each in tree.body if isinstance(each, ast.FunctionDef)]
    rest = ast.unparse(ast.Module([each for each in tree.body if each not in tests], []))
    if FULL.search(rest):
        return set()
    daily = [
        test
        for test in tests
        if test.name.startswith("test")
        and not any(FULL.fullmatch(ast.unparse(mark)) for mark in test.decorator_list)
    ]
    return {name for test in daily for name in [*held(ast.unparse(test)), *held(rest)]}


def test_every_promise_has_a_test_that_does_not_wait_for_the_night() -> None:
    files = (ROOT / "tests").rglob("test_*.py")
    daily = {name for path in files for name in held_daily(path.read_text(encoding="utf-8"))}
    assert sorted(set(promised()) - daily) == []


def test_every_mark_has_a_promise() -> None:
    assert sorted(all_held() - set(promised())) == []


def test_every_mention_has_a_promise_and_no_promise_is_given_twice() -> None:
    assert sorted(mentioned() - set(promised())) == []
    assert len(set(promised())) == len(promised()) > 10


PROMISING = re.compile(
    r"\b(never|always|whatever|guarantees?|nobody may|nothing (?:can|that|under way)"
    r"|no (?:command|datagram|waypoint|key|token|port) is)\b",
    re.IGNORECASE,
)
"""Words that promise."""
NOT_OURS = (
    "whatever the network does",  # of the published controller
    "exact whatever the correlation",  # of a formula
    "what was sent and never arrived",
    "meets some rows twice or never",
    "nothing that flies looks at it",  # P-LINK-7, in the table of metrics
    "Packets never overtake each other",  # what a key asks for
)
"""Where such words promise nothing, or nothing of their own."""
ABOUT_TESTS = re.compile(r"faults|search|adversary|mutants|promises")
"""Pages of results, and the promises themselves."""


def unheld(text: str) -> list[str]:
    """Paragraphs, items and rows of a page that promise something and name no promise."""
    for phrase in NOT_OURS:
        text = re.sub(r"\s+".join(map(re.escape, phrase.split())), "", text)
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    blocks = re.split(r"\n\s*\n|\n(?=[-*|] )", text)
    return [each for each in blocks if PROMISING.search(each) and not PROMISE.search(each)]


def test_whatever_the_docs_promise_has_an_id() -> None:
    pages = [path for path in DOCUMENTS if not ABOUT_TESTS.search(path.name)]
    assert len(pages) >= 8
    assert {path.name: found for path in pages if (found := unheld(path.read_text("utf-8")))} == {}


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("No command is lost.", 1),
        ("It never stops [P-A-1].", 0),
        ("It never stops [P-A-1].\n\nIt always flies.", 1),
        ("- it never stops [P-A-1]\n- whatever happens, it flies", 1),
        ("| a | never |\n| b | always [P-A-1] |", 1),
        ("```\nnever\n```", 0),
        ("It flies.", 0),
        ("what was sent and\nnever arrived", 0),
    ],
)
def test_a_promise_without_an_id_is_found(text: str, count: int) -> None:
    assert len(unheld(text)) == count


SKIPS = re.compile(r"\b(pytest\.)?(mark\.)?(skip|skipif|xfail|importorskip|exit)\b")


def skipping(source: str) -> list[str]:
    """Tests of a file that hold a promise and may be skipped, by whatever way there is."""
    tree = ast.parse(source)
    functions = [each for each in tree.body if isinstance(each, ast.FunctionDef)]
    rest = ast.Module([each for each in tree.body if each not in functions], [])
    if held(ast.unparse(rest)) and SKIPS.search(ast.unparse(rest)):
        return ["the file"]
    fixtures = {
        each.name: each
        for each in functions
        if any("fixture" in ast.unparse(mark) for mark in each.decorator_list)
    }
    found = []
    for test in functions:
        if not (
            held(ast.unparse(test)) or (test.name.startswith("test") and held(ast.unparse(rest)))
        ):
            continue
        asked = [fixtures[arg.arg] for arg in test.args.args if arg.arg in fixtures]
        texts = [ast.unparse(each) for each in (rest, test, *asked)]
        if any(SKIPS.search(text) for text in texts):
            found.append(test.name)
    return found


def test_a_promise_is_skipped_nowhere() -> None:
    """A test that may be skipped holds nothing."""
    files = (ROOT / "tests").rglob("test_*.py")
    found = {path.name: skipping(path.read_text(encoding="utf-8")) for path in files}
    own = found.pop("test_promises.py")
    assert own == [], "no promise is held here"
    assert {name: tests for name, tests in found.items() if tests} == {}


def test_what_the_tests_of_promises_share_skips_nothing() -> None:
    files = [path for path in (ROOT / "tests").rglob("test_*.py") if held(path.read_text("utf-8"))]
    shared = {
        near
        for path in files
        for name in re.findall(r"^(?:from|import) (\w+)", path.read_text("utf-8"), re.MULTILINE)
        if (near := path.with_name(f"{name}.py")).exists()
    }
    assert "rendering.py" in {path.name for path in shared}
    texts = {path.name: ast.unparse(ast.parse(path.read_text("utf-8"))) for path in shared}
    assert [name for name, text in texts.items() if re.search(r"pytest\.\w*skip", text)] == []


MARK = '@pytest.mark.promise("P-A-1")'


@pytest.mark.parametrize(
    ("source", "found"),
    [
        (f"@pytest.mark.skipif(x)\n{MARK}\ndef test_a(): ...", ["test_a"]),
        (f"{MARK}\n@pytest.mark.xfail\ndef test_a(): ...", ["test_a"]),
        (f"{MARK}\ndef test_a():\n    pytest.importorskip('x')", ["test_a"]),
        (f"{MARK}\ndef test_a():\n    if x:\n        pytest.skip('x')", ["test_a"]),
        (f"{MARK}\n@pytest.mark.parametrize('a', [pytest.param(1, marks=pytest.mark.skip)])\n"
         "def test_a(a): ...", ["test_a"]),
        (f"@pytest.fixture\ndef x(): pytest.skip('x')\n{MARK}\ndef test_a(x): ...", ["test_a"]),
        (f"pytest.importorskip('x')\n{MARK}\ndef test_a(): ...", ["test_a"]),
        ("pytestmark = [pytest.mark.promise('P-A-1'), pytest.mark.skip]\ndef test_a(): ...",
         ["the file"]),
        (f"{MARK}\ndef test_a(): ...\ndef test_b(): pytest.skip('x')", []),
        (f"{MARK}\ndef test_a(): assert skipped == 0", []),
    ],
)  # fmt: skip
def test_every_way_to_skip_a_promise_is_found(source: str, found: list[str]) -> None:
    assert skipping(source) == found


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('@pytest.mark.promise("P-A-1")\ndef test_a(): ...', ["P-A-1"]),
        ('pytestmark = [pytest.mark.promise("P-A-1"), pytest.mark.promise("P-B-2")]',
         ["P-A-1", "P-B-2"]),
        ('"""pytest.mark.promise("P-A-1")"""', []),
        ('# pytest.mark.promise("P-A-1")', []),
    ],
)  # fmt: skip
def test_a_mark_is_read_from_the_code_alone(source: str, found: list[str]) -> None:
    assert held(source) == found


@pytest.mark.parametrize(
    ("source", "found"),
    [
        (f"{MARK}\ndef test_a(): ...", {"P-A-1"}),
        (f"@pytest.mark.process\n{MARK}\ndef test_a(): ...", {"P-A-1"}),
        (f"@pytest.mark.full\n{MARK}\ndef test_a(): ...", set()),
        (f"pytestmark = [pytest.mark.full]\n{MARK}\ndef test_a(): ...", set()),
        ("pytestmark = pytest.mark.promise('P-A-1')\n@pytest.mark.full\ndef test_a(): ...", set()),
        (f"{MARK}\n@pytest.mark.parametrize('a', [1, pytest.param(2, marks=pytest.mark.full)])\n"
         "def test_a(a): ...", {"P-A-1"}),
    ],
)  # fmt: skip
def test_a_test_of_the_night_alone_holds_nothing_by_day(source: str, found: set[str]) -> None:
    assert held_daily(source) == found
