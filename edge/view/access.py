"""Access to the live page: the requests that its server accepts, and the addresses at which it can be reached.

A browser runs pages of strangers, which can reach a server on loopback, too. Three things keep them out: the name that
the browser was asked to reach (a stranger's name may resolve to this machine), the origin of the page that opens a
socket, and, where other machines can reach the server, a token. Behind a proxy the origin of our page differs from the
name: such a page needs the token, too.
"""

import hmac
import ipaddress
import re
import secrets
import socket
import struct
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from fcntl import ioctl
from http import HTTPStatus
from typing import Final
from urllib.parse import parse_qs

from edge.errors import UsageError

PAGE: Final = "/"
SOCKET: Final = "/ws"
SHORTEST_TOKEN: Final = 12
_HOST: Final = re.compile(r"(?:\[(?P<address>[0-9A-Fa-f:.]+)\]|(?P<name>[\w.-]+))(?::[0-9]*)?")


@dataclass(frozen=True, slots=True)
class Access:
    """Conditions that a request must meet."""

    host: str  # name or address at which the server listens
    name: str  # of this machine, with or without a domain
    token: str | None  # None where it is not needed

    def refusal(self, path: str, hosts: Sequence[str], origins: Sequence[str]) -> tuple[HTTPStatus, str] | None:
        """Return status and reason with which a request is refused; None if it is granted.

        The path has its query; `hosts` and `origins` are the values of these headers, the latter of browsers alone.
        """
        called = ", ".join(hosts) or "nothing"
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            remedy = "open the address that edge-sr printed when it started, or name this one with --view-host"
            proxies = "a proxy must send the host and port of edge-sr as Host"
            return HTTPStatus.FORBIDDEN, f"this server is not called {called}; {remedy}; {proxies}"
        place, _, query = path.partition("?")
        given = parse_qs(query)
        # A browser sends no origin when a page asks why its socket was refused, so that the page names its own.
        origins = [*origins, *given.get("origin", [])]
        token = given.get("token", [""])[-1].encode(errors="surrogatepass")
        trusted = self.token is not None and hmac.compare_digest(token, self.token.encode())
        for origin in origins:
            if origin != f"http://{hosts[0]}" and not (place == SOCKET and trusted):
                text = f"pages of {', '.join(origins)} may not send requests to this server"
                if place == SOCKET:
                    text += ": pass --view-token T to edge-sr, and add ?token=T to the page's address"
                return HTTPStatus.FORBIDDEN, text
        if place not in (PAGE, SOCKET):
            return HTTPStatus.NOT_FOUND, f"there is only {PAGE}"
        # The page alone shows nothing, and removes the token from the address bar: it must open again without it.
        if place == SOCKET and self.token is not None and not trusted:
            text = "the token is missing or wrong: open the address that edge-sr printed when it started"
            return HTTPStatus.FORBIDDEN, text
        return None

    def urls(self, port: int, addresses: Sequence[str] = ()) -> list[str]:
        """Return the addresses of the page; this machine's name is the last, since others may not know it."""
        hosts = [*addresses, self.name] if is_everything(self.host) else [self.host]
        query = "" if self.token is None else f"?token={self.token}"
        return [f"http://{f'[{host}]' if ':' in host else host}:{port}{PAGE}{query}" for host in hosts]

    def _is_ours(self, host: str) -> bool:
        matched = _HOST.fullmatch(host)
        if matched is None:  # also a host with a user's name in front of ours
            return False
        name = (matched["address"] or matched["name"]).lower()
        if name in ("localhost", self.host.lower()):
            return True
        address = _address(name)
        if address is not None:
            return address.is_loopback or is_everything(self.host)
        if self.token is not None and "." not in name:  # as a proxy calls its upstream; no stranger's name lacks a dot
            return True
        # Any domain will do: a stranger may use this name too, but needs the token where other machines can reach us.
        return not is_loopback(self.host) and name.partition(".")[0] == self.name.lower().partition(".")[0]


def grant(host: str, name: str, token: str | None) -> Access:
    """Return the conditions for a server at `host`, on a machine called `name`: a token unless it is on loopback.

    Raises UsageError where the token is too easy, or cannot be part of an address.
    """
    if token is not None and not re.fullmatch(rf"[A-Za-z0-9_-]{{{SHORTEST_TOKEN},200}}", token):
        expected = f"expected at least {SHORTEST_TOKEN} letters, digits, - or _"
        raise UsageError(f"a token of {len(token)} characters for the live page: {expected}, or leave it to be made")
    if token is None and not is_loopback(host):
        token = secrets.token_urlsafe(16)
    return Access(host, name, token)


def is_loopback(host: str) -> bool:
    """Return True if only this machine can reach the host."""
    address = _address(host)
    return host.lower() == "localhost" if address is None else address.is_loopback


def is_everything(host: str) -> bool:
    """Return True if the host stands for all addresses of this machine."""
    address = _address(host)
    return address is not None and address.is_unspecified


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


# The kernel's `ifreq` with an IPv4 address: name of the interface, family and port, address; room for other uses.
_REQUEST: Final = struct.Struct("16s4x4s232x")


def own_addresses() -> list[str]:
    """Return the IPv4 addresses of this machine at which others on its networks reach it."""
    addresses: list[str] = []
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        for _, name in socket.if_nameindex():
            with suppress(OSError):  # SIOCGIFADDR of an interface without an IPv4 address
                answer = ioctl(asked, 0x8915, _REQUEST.pack(name.encode(), bytes(4)))
                addresses.append(socket.inet_ntoa(_REQUEST.unpack(answer)[1]))
    usable = (ip for ip in map(ipaddress.ip_address, addresses) if not (ip.is_loopback or ip.is_link_local))
    return list(dict.fromkeys(map(str, usable)))
