# SPDX-License-Identifier: Apache-2.0

"""Move this process into a network namespace of its own, with one TUN device (Linux only).

The module uses system calls alone, because a container often has neither `ip` nor `unshare`.

Source: Linux, include/uapi/linux/sched.h, sockios.h, if_tun.h, route.h, ipv6.h.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
import socket
import struct
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from cloudrc.base.errors import MissingPrerequisiteError

MTU = 1500  # longest IP packet on the link [bytes]
DEVICE = "cloudrc"
TUN = "/dev/net/tun"
QUEUE_PACKETS = 1_000  # packets that wait in a device until the relay reads them
OTHERWISE = "or use 'cloudrc link relay tcp', which needs no privileges"
"""End of every message about missing privileges."""


class Addresses(NamedTuple):
    """Addresses of one end of the link."""

    ipv4: str
    ipv6: str


ADDRESSES = {
    "client": Addresses("10.77.0.1", "fd77::1"),
    "server": Addresses("10.77.0.2", "fd77::2"),
}
"""End of the link -> its addresses. They are the same in every run, because nothing else is in the
namespaces."""

_NEWUSER, _NEWNET = 0x10000000, 0x40000000
_TUNSETIFF, _TUN_WITHOUT_HEADER = 0x400454CA, 0x1001
_ADDRESS, _NETMASK, _MTU, _FLAGS, _QUEUE = 0x8916, 0x891C, 0x8922, 0x8914, 0x8943
_INDEX, _ADD_ROUTE = 0x8933, 0x890B
_UP, _ROUTE_UP = 1, 1


def enter() -> str:
    """Move this process, which has one thread, into a new network namespace.

    Returns:
        The privilege that allowed it: "root", or "unprivileged user namespaces".

    Raises:
        MissingPrerequisiteError: If the kernel does not allow it; the text says what to allow.
    """
    if not hasattr(os, "memfd_create"):  # Linux alone has it
        raise MissingPrerequisiteError(
            "network namespaces need Linux", fix=f"use Linux, {OTHERWISE}"
        )
    try:
        _unshare(_NEWNET)
    except PermissionError:
        _enter_user_namespace()
        return "unprivileged user namespaces"
    except OSError as error:
        raise _not_allowed(f"no network namespace: {error.strerror}") from None
    return "root"


def _enter_user_namespace() -> None:
    user, group = os.getuid(), os.getgid()
    try:
        _unshare(_NEWUSER | _NEWNET)
        # The programs keep their user: they see no other rights than outside.
        Path("/proc/self/setgroups").write_text("deny", encoding="ascii")
        Path("/proc/self/uid_map").write_text(f"{user} {user} 1", encoding="ascii")
        Path("/proc/self/gid_map").write_text(f"{group} {group} 1", encoding="ascii")
    except OSError as error:
        raise _not_allowed(f"no user namespace: {error.strerror}") from None


def _unshare(flags: int) -> None:
    library = ctypes.CDLL(None, use_errno=True)  # os.unshare exists from Python 3.12 only
    if library.unshare(flags):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def _not_allowed(what: str) -> MissingPrerequisiteError:
    """Return an error about `what`, with the setting of this machine that allows it."""
    settings = (
        ("kernel/apparmor_restrict_unprivileged_userns", "1", "0"),  # Ubuntu 23.10 and newer
        ("kernel/unprivileged_userns_clone", "0", "1"),  # Debian
        ("user/max_user_namespaces", "0", "10000"),
        ("user/max_net_namespaces", "0", "10000"),
    )
    for name, bad, good in settings:
        file = Path("/proc/sys", name)
        if file.exists() and file.read_text(encoding="ascii").strip() == bad:
            allow = f"as root: sysctl -w {name.replace('/', '.')}={good}"
            return MissingPrerequisiteError(what, fix=f"{allow}; {OTHERWISE}")
    allow = "run as root; in a container allow --cap-add SYS_ADMIN --cap-add NET_ADMIN"
    return MissingPrerequisiteError(what, fix=f"{allow} --device {TUN}; {OTHERWISE}")


def open_device(own: Addresses) -> tuple[int, bool]:
    """Make the TUN device of this namespace, with the addresses of its end; bring it up.

    Returns:
        The file descriptor that reads and writes IP packets, and whether the device has IPv6.
    """
    try:
        device = os.open(TUN, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise MissingPrerequisiteError(
            f"{TUN} is missing",
            fix=f"as root: modprobe tun; in a container allow --device {TUN}; {OTHERWISE}",
        ) from None
    except OSError as error:
        raise MissingPrerequisiteError(
            f"{TUN}: {error.strerror}", fix=f"as root: chmod 666 {TUN}; {OTHERWISE}"
        ) from None
    try:
        fcntl.ioctl(
            device, _TUNSETIFF, struct.pack("16sH22x", DEVICE.encode(), _TUN_WITHOUT_HEADER)
        )
        return device, _configure(own)
    except OSError as error:
        os.close(device)
        raise _not_allowed(f"no TUN device: {error.strerror}") from None


def _configure(own: Addresses) -> bool:
    name = DEVICE.encode()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        fcntl.ioctl(control, _FLAGS, struct.pack("16sH22x", b"lo", _UP))
        for request, address in ((_ADDRESS, own.ipv4), (_NETMASK, "255.255.255.0")):
            fcntl.ioctl(control, request, struct.pack("16s16s8x", name, _ipv4(address)))
        fcntl.ioctl(control, _MTU, struct.pack("16si20x", name, MTU))
        with suppress(PermissionError):  # only root may; else 500 packets wait
            fcntl.ioctl(control, _QUEUE, struct.pack("16si20x", name, QUEUE_PACKETS))
        fcntl.ioctl(control, _FLAGS, struct.pack("16sH22x", name, _UP))
        _route_multicast(control)
        row = fcntl.ioctl(control, _INDEX, struct.pack("16si20x", name, 0))
    index = struct.unpack("16si20x", row)[1]
    try:
        with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as control:
            ipv6 = socket.inet_pton(socket.AF_INET6, own.ipv6)
            fcntl.ioctl(control, _ADDRESS, struct.pack("16sIi", ipv6, 64, index))
    except OSError:  # IPv6 is off on this machine
        return False
    return True


def _route_multicast(control: socket.socket) -> None:
    """Send multicast through the device, as programs that discover each other expect."""
    device = ctypes.create_string_buffer(DEVICE.encode())
    route = struct.pack(
        "L16s16s16sHhLPhPLLH",
        *(0, _ipv4("224.0.0.0"), _ipv4("0.0.0.0"), _ipv4("240.0.0.0"), _ROUTE_UP, 0, 0, 0, 0),
        *(ctypes.addressof(device), 0, 0, 0),
    )
    fcntl.ioctl(control, _ADD_ROUTE, route)


def _ipv4(address: str) -> bytes:
    """Return an IPv4 address as a `struct sockaddr_in` of the kernel."""
    return struct.pack("=HH4s8x", socket.AF_INET, 0, socket.inet_aton(address))


def identity(process: int | str = "self") -> str:
    """Return the identity of a process's network namespace; "" if it cannot be read."""
    try:
        return os.readlink(f"/proc/{process}/ns/net")
    except OSError:  # it has ended, or belongs to another user
        return ""


def inhabitants(namespace: str) -> list[int]:
    """Return the ids of the other processes in a network namespace, however they were started."""
    processes = [int(name) for name in os.listdir("/proc") if name.isdecimal()]
    return [one for one in processes if one != os.getpid() and identity(one) == namespace]


def kill(namespace: str, signal: int) -> None:
    """Send a signal to every other process in a network namespace."""
    for process in inhabitants(namespace):
        with suppress(OSError):
            os.kill(process, signal)
