"""Processes of `cloudrc link verify`: what they cannot do, and how they report an early end."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from cloudrc.cli import link_processes
from cloudrc.cli.link_processes import LOOPBACK, ShaperAddresses, ShaperProcess, check_shaper
from cloudrc.config.load import load_profile
from cloudrc.drivers.process import PARENT
from cloudrc.errors import BadInputError, CloudrcError

ANY = (LOOPBACK, 9)


@pytest.mark.parametrize(
    ("code", "words", "exit_code", "says"),
    [
        (2, "cloudrc: error: no such profile", 2, "the uplink is not shaped: no such profile"),
        (
            2,
            "netem cannot do that; set link.mode=relay, which can, or leave it out",
            2,
            "netem cannot do that; use --shaper relay, which can, or leave it out",
        ),
        (3, "cloudrc: error: no program tc", 3, "the uplink is not shaped: no program tc"),
        (4, "too slow", 4, "too slow"),
        (70, "internal error: X", 6, "its process ended with 70: internal error: X"),
        (0, "", 6, "its process ended with 0: it left no message"),
    ],
)
def test_an_early_end_has_the_exit_code_of_the_process(
    code: int, words: str, exit_code: int, says: str, tmp_path: Path
) -> None:
    process = subprocess.Popen(["sh", "-c", f"exit {code}"])
    one = ShaperProcess(ShaperAddresses(ANY, ANY, ANY), tmp_path, process)
    one.log.write_text(f"before\n{words}\n" if words else "")
    process.wait()
    with pytest.raises(CloudrcError) as ended:
        link_processes._wait({"uplink": one})
    assert ended.value.exit_code == exit_code
    assert str(ended.value).endswith(says)


def test_a_profile_that_netem_cannot_do_names_the_flag() -> None:
    with pytest.raises(BadInputError) as refused:
        check_shaper(load_profile("lossy"), "netem")
    assert str(refused.value) == (
        "uplink: netem cannot do loss.delay_bad_ms (more delay while a burst of losses lasts); "
        "use --shaper relay, which can, or leave it out"
    )


@pytest.mark.parametrize(("name", "mode"), [("lossy", "relay"), ("paper-p3", "netem")])
def test_a_profile_that_the_shaper_can_do_is_accepted(name: str, mode: str) -> None:
    check_shaper(load_profile(name), mode)


def test_a_links_process_gets_the_id_of_its_parent(tmp_path: Path) -> None:
    place = ShaperAddresses(ANY, ANY, ANY, inside=("printenv", PARENT))
    one = link_processes._start(tmp_path, "uplink", place, "relay")
    one.process.wait()
    assert one.log.read_text().split() == [str(os.getpid())]
