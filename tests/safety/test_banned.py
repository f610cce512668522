"""No code of the repository runs foreign data as code; checked in the syntax trees."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import pytest

from cloudrc.cluster.link import APPLY_SCRIPT

ROOT = Path(__file__).resolve().parents[2]
SHIPPED = [*sorted((ROOT / "cloudrc").rglob("*.py")), *sorted((ROOT / "tools").rglob("*.py"))]
TESTS = sorted((ROOT / "tests").rglob("*.py"))
BENCH = ROOT / "cloudrc" / "cli" / "bench.py"

MODULES = {"pickle", "cPickle", "_pickle", "marshal", "shelve", "dill", "cloudpickle", "jsonpickle"}
CALLS = {"eval", "exec", "compile", "__import__"}
LOADERS = {"load", "load_all", "full_load", "full_load_all", "unsafe_load", "unsafe_load_all"}
SHELLS = {"os": {"system", "popen"}, "subprocess": {"getoutput", "getstatusoutput"}}
NAMES = {"builtins": CALLS, "yaml": LOADERS, **SHELLS}
"""Banned names of modules that are allowed themselves."""
SH = {"sh", "bash", "dash", "busybox", "ash", "zsh"}
SAFE_LOADERS = {"SafeLoader", "CSafeLoader"}


def breaches(tree: ast.Module) -> Iterator[str]:
    """Find what is banned in a file."""
    safe = _safe_loaders(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [alias.name for alias in node.names]
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else names
            for module in modules:
                if module.split(".")[0] in MODULES:
                    yield f"{node.lineno}: imports {module}"
            yield from _of_names(node)
        elif isinstance(node, ast.Call):
            yield from _of_call(node, safe)
    for program in programs(tree):
        yield from (f"in a program: {breach}" for breach in breaches(program))


def _of_names(node: ast.Import | ast.ImportFrom) -> Iterator[str]:
    """Find imports of banned names, or under a name that hides the module."""
    for alias in node.names:
        if isinstance(node, ast.ImportFrom) and node.module in NAMES:
            if alias.name in NAMES[node.module] | {"*"}:
                yield f"{node.lineno}: imports {alias.name} from {node.module}"
        elif isinstance(node, ast.Import) and alias.name in NAMES and alias.asname is not None:
            yield f"{node.lineno}: imports {alias.name} as {alias.asname}"


def programs(tree: ast.Module) -> Iterator[ast.Module]:
    """Find texts in a file that are Python programs, for another process."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            if "import " in node.value:
                with suppress(SyntaxError):
                    yield ast.parse(node.value)


def _of_call(node: ast.Call, safe: set[str]) -> Iterator[str]:
    name = ast.unparse(node.func)
    if name.removeprefix("builtins.") in CALLS:
        yield f"{node.lineno}: calls {name}"
    for keyword in node.keywords:
        off = isinstance(keyword.value, ast.Constant) and keyword.value.value is False
        if keyword.arg == "shell" and not off:
            yield f"{node.lineno}: shell={ast.unparse(keyword.value)}"
        if keyword.arg == "allow_pickle" and not off:
            yield f"{node.lineno}: allow_pickle"
    module, _, called = name.rpartition(".")
    if called == "import_module" and node.args and isinstance(node.args[0], ast.Constant):
        if str(node.args[0].value).partition(".")[0] in MODULES:
            yield f"{node.lineno}: imports {node.args[0].value}"
    if called in SHELLS.get(module, ()):
        yield f"{node.lineno}: calls {name}"
    if module == "yaml" and called in LOADERS:
        given = [*node.args[1:2], *(k.value for k in node.keywords if k.arg == "Loader")]
        if not given or not all(_is_safe(loader, safe) for loader in given):
            yield f"{node.lineno}: {name} without a safe loader"


def _is_safe(loader: ast.expr, safe: set[str]) -> bool:
    return ast.unparse(loader).rpartition(".")[2] in SAFE_LOADERS | safe


def _safe_loaders(tree: ast.Module) -> set[str]:
    """Find names in a file that are always safe loaders, or derive from them."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and node.bases:
            if all(_is_safe(base, found) for base in node.bases):
                found.add(node.name)
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            value = ast.unparse(node.value)
            if "SafeLoader" in value and "Unsafe" not in value:
                found.add(node.targets[0].id)
    return found


def shells(tree: ast.Module) -> Iterator[str]:
    """Find the commands that are given to a shell."""
    for node in ast.walk(tree):
        if isinstance(node, ast.List | ast.Tuple):
            words = [each.value if isinstance(each, ast.Constant) else None for each in node.elts]
            for i, (program, option) in enumerate(pairwise(words)):
                if str(program).rpartition("/")[2] in SH and option == "-c":
                    yield ", ".join(map(ast.unparse, node.elts[i + 2 : i + 3]))


def found_in(paths: list[Path]) -> dict[str, list[str]]:
    every = {path: list(breaches(ast.parse(path.read_text()))) for path in paths}
    return {path.relative_to(ROOT).as_posix(): found for path, found in every.items() if found}


@pytest.mark.promise("foreign-files-run-nothing")
def test_the_package_runs_no_foreign_bytes() -> None:
    """The one exception: the bench measures the pickle of the paper's tunnel."""
    bench = BENCH.relative_to(ROOT).as_posix()
    assert found_in(SHIPPED) == {bench: ["in a program: 2: imports pickle"]}


def test_a_shell_gets_only_one_fixed_program() -> None:
    """Foreign text comes in as arguments, which the program does not split."""
    given = {text for path in SHIPPED for text in shells(ast.parse(path.read_text()))}
    assert given == {"APPLY_SCRIPT"}
    quoted = re.sub(r'"(?:\\.|[^"\\])*"', "", APPLY_SCRIPT)
    assert not re.search(r"\$[0-9@*]", quoted), "an argument stays one word"


def test_the_bench_unpickles_only_its_own_pickles() -> None:
    (program,) = programs(ast.parse(BENCH.read_text()))
    calls = [ast.unparse(node) for node in ast.walk(program) if isinstance(node, ast.Call)]
    assert {call for call in calls if call.startswith("pickle.")} == {
        "pickle.dumps(message, 4)",
        "pickle.loads(pickle.dumps(message, 4))",
    }
    mentioned = [n for n in ast.walk(program) if isinstance(n, ast.Name) and n.id == "pickle"]
    assert len(mentioned) == len([call for call in calls if call.startswith("pickle.")])
    # Its input is the number of calls, and one line per round.
    given = [ast.unparse(n) for n in ast.walk(program) if isinstance(n, ast.Attribute)]
    assert {name for name in given if name.startswith("sys.")} == {"sys.argv", "sys.stdin"}
    assert "int(sys.argv[1])" in calls
    assert not {"open", "input"} & {call.partition("(")[0] for call in calls}


def test_no_test_runs_foreign_bytes() -> None:
    """The one exception: a test that checks that banned imports are found."""
    found = found_in([path for path in TESTS if path != Path(__file__).resolve()])
    assert found == {"tests/test_architecture.py": ["in a program: 1: imports pickle"]}


@pytest.mark.parametrize(
    "code",
    [
        "import pickle",
        "from pickle import loads",
        "def f():\n    import marshal as m",
        "import dill, json",
        "eval('1')",
        "exec(text)",
        "builtins.eval(text)",
        "__import__('os')",
        "importlib.import_module('pickle')",
        "import_module('marshal')",
        "yaml.load(text)",
        "yaml.load(text, yaml.Loader)",
        "yaml.load(text, Loader=yaml.UnsafeLoader)",
        "yaml.unsafe_load(text)",
        "yaml.full_load(text)",
        "yaml.load_all(text)",
        "subprocess.run(command, shell=True)",
        "subprocess.run(command, shell=is_shell)",
        "os.system(command)",
        "subprocess.getoutput(command)",
        "from os import system",
        "from os import path, popen as run",
        "from os import *",
        "from subprocess import getoutput",
        "from yaml import load",
        "from yaml import SafeLoader, unsafe_load as load",
        "from builtins import eval as value",
        "import yaml as y\ny.load(text)",
        "numpy.load(path, allow_pickle=True)",
        "run([sys.executable, '-c', 'import marshal'])",
    ],
)
def test_a_breach_is_found(code: str) -> None:
    assert list(breaches(ast.parse(code)))


@pytest.mark.parametrize(
    "code",
    [
        "yaml.safe_load(text)",
        "yaml.load(text, yaml.CSafeLoader)",
        "class Mine(yaml.SafeLoader): ...\nyaml.load(text, Loader=Mine)",
        "subprocess.run(command, shell=False)",
        "model.eval()",
        "importlib.import_module('json')",
        "from os import path\nfrom yaml import safe_load, CSafeLoader",
        "json.load(file)",
    ],
)
def test_harmless_code_is_no_breach(code: str) -> None:
    assert list(breaches(ast.parse(code))) == []
