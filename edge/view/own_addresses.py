"""Addresses at which other computers can reach this one. Linux; elsewhere none is found."""

import ipaddress
import socket
import struct
from contextlib import suppress
from pathlib import Path
from typing import Final

try:
    from fcntl import ioctl
except ImportError:
    ioctl = None

_SIOCGIFADDR: Final = 0x8915
_REQUEST: Final = struct.Struct("16s4x4s232x")
"""The kernel's `ifreq` with an IPv4 address: name of the interface, family and port, address; room for other uses."""
_IPV6: Final = Path("/proc/net/if_inet6")


def own_addresses(host: str) -> list[str]:
    """Return the addresses of this machine that a server at 0.0.0.0 (IPv4) or :: (IPv6) listens at.

    Those that only this machine reaches, and those that need the name of an interface, are left out.
    """
    usable = (ipaddress.ip_address(one) for one in (_ipv6() if ":" in host else _ipv4()))
    return list(dict.fromkeys(str(one) for one in usable if not (one.is_loopback or one.is_link_local)))


def _ipv4() -> list[str]:
    found: list[str] = []
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        for _, name in socket.if_nameindex():
            if ioctl is None:
                break
            with suppress(OSError):  # an interface without an IPv4 address
                answer = ioctl(asked, _SIOCGIFADDR, _REQUEST.pack(name.encode(), bytes(4)))
                found.append(socket.inet_ntoa(_REQUEST.unpack(answer)[1]))
    return found


def _ipv6() -> list[str]:
    with suppress(OSError):
        return [socket.inet_ntop(socket.AF_INET6, bytes.fromhex(line[:32])) for line in _IPV6.read_text().splitlines()]
    return []
