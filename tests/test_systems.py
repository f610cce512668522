# SPDX-License-Identifier: Apache-2.0

"""cloudrc on macOS and Windows, as far as a Linux can show it."""

import os

import pytest

from tests.support.commands import python

LINUX_ALONE = {
    "os": "sched_getaffinity sched_setaffinity sched_setscheduler sched_getscheduler sched_param "
    "SCHED_FIFO SCHED_RR pidfd_open memfd_create eventfd splice copy_file_range setns unshare "
    "getrandom posix_fadvise posix_fallocate O_TMPFILE O_DIRECT O_PATH setresuid getresuid",
    "select": "epoll",
    "socket": "AF_PACKET AF_NETLINK AF_VSOCK SO_MARK SO_BINDTODEVICE TCP_QUICKACK TCP_CORK "
    "TCP_USER_TIMEOUT SOCK_NONBLOCK SOCK_CLOEXEC SO_PEERCRED SO_DOMAIN SO_PROTOCOL",
    "signal": "sigwaitinfo sigtimedwait SIGRTMIN SIGRTMAX",
    "time": "CLOCK_BOOTTIME CLOCK_TAI",
    "resource": "prlimit RLIMIT_RTPRIO",
    "fcntl": "F_SETPIPE_SZ F_GETPIPE_SZ F_ADD_SEALS F_OFD_SETLK",
}
"""Module -> names that it has on Linux, but not on macOS. Source: the documentation of Python."""


@pytest.mark.process
def test_a_flight_in_real_time_uses_nothing_that_macos_lacks(tmp_path):
    lines = ["import importlib", f"for module, names in {LINUX_ALONE}.items():"]
    lines.append("    module = importlib.import_module(module)")
    lines.append("    [delattr(module, name) for name in names.split() if hasattr(module, name)]")
    (tmp_path / "sitecustomize.py").write_text("\n".join(lines))
    line = "-m cloudrc run hover --mode local --report none"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    flown = python(*line.split(), cwd=tmp_path, env=environment)
    assert "Error" not in flown.stderr, flown.stderr
    assert flown.stdout.endswith("report.json\n"), flown.stdout


def test_windows_is_sent_to_wsl2():
    program = "import sys; sys.platform = 'win32'; import cloudrc.doors.cli.main"
    found = python("-c", program)
    assert (found.returncode, found.stderr.count("\n")) == (3, 1)
    assert "WSL2" in found.stderr


NOT_WINDOWS = "fcntl grp pwd resource termios pty tty"
"""Modules of Python that Windows lacks, and names of os. Source: the documentation of Python."""
NOT_WINDOWS_OS = "O_NONBLOCK O_CLOEXEC geteuid getuid getgid fork sched_getaffinity"


def test_the_link_as_a_library_needs_nothing_that_windows_lacks(tmp_path):
    trace = tmp_path / "trace.csv"
    trace.write_text("time_s,delay_ms\n0,45\n")
    program = f"""
import os, sys
[sys.modules.__setitem__(name, None) for name in "{NOT_WINDOWS}".split()]
[delattr(os, name) for name in "{NOT_WINDOWS_OS}".split()]
import cloudrc.link as link
[getattr(link, name) for name in link.__all__]
up, down = link.open("lte", 1)
print(up.table(10, 0.01).shape, up.expected().mean > 0, down.send(0, 0, 100, 0) != [])
up, _ = link.open({{"uplink": {{"trace": {str(trace)!r}}}}}, 1)
print(up.send(0, 0, 100, 0))
"""
    found = python("-c", program)
    assert found.stderr == ""
    assert found.stdout == "(10,) True True\n(45000000,)\n"
