"""Who may ask the dashboard: names of the server, the token, and the origin of a request."""

from __future__ import annotations

import hmac
import ipaddress
import platform
import secrets
from collections.abc import Iterable
from dataclasses import dataclass, field
from hashlib import sha256
from urllib.parse import urlsplit

LOOPBACK = "127.0.0.1"


@dataclass(frozen=True)
class Access:
    """Rules of access of one server.

    Attributes
    ----------
    names : frozenset of str
        Names under which browsers reach the server, lower case. Addresses are always allowed: a foreign page can give
        its own name the address of this computer, but it cannot make a browser send an address in its place.
    token : str
        What a client must present once; empty where none is required.
    secure : bool
        Whether the connection is encrypted.
    session : str
        Secret that a browser keeps after it has presented the token; new at every start.
    """

    names: frozenset[str]
    token: str = ""
    secure: bool = False
    session: str = field(default_factory=lambda: secrets.token_urlsafe(32))

    def admits(self, host: str) -> bool:
        """Return whether the header ``Host`` of a request names this server."""
        name = _name(host)
        return name in self.names or _is_address(name)

    def same_origin(self, origin: str | None, host: str) -> bool:
        """Return whether a request that changes something comes from a page of this server: header ``Origin``."""
        if origin is None:
            return False
        try:
            return bool(host) and urlsplit(origin).netloc.casefold() == host.casefold()
        except ValueError:
            return False

    def opens(self, token: str) -> bool:
        """Return whether this is the token; the time that it takes does not depend on where they differ."""
        return bool(self.token) and _equal(token, self.token)

    def knows(self, session: str | None) -> bool:
        """Return whether a request may read: no token is required, or its browser has presented it."""
        return not self.token or _equal(session or "", self.session)


def access_for(host: str, names: Iterable[str] = (), *, secure: bool = False, control: bool = False) -> Access:
    """Return the rules of a server that listens on an address.

    A new token is required where other computers reach it, and where it may start what moves a machine: every user of
    this computer reaches loopback.
    """
    known = {"localhost", host, platform.node(), *names}
    return Access(
        frozenset(name.casefold() for name in known if name),
        "" if is_loopback(host) and not control else secrets.token_urlsafe(24),
        secure,
    )


def is_loopback(host: str) -> bool:
    """Return whether an address is reached from this computer only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _equal(given: str, expected: str) -> bool:
    """Compare hashes, so that neither length nor content shows in the time."""
    first, second = (sha256(text.encode("utf-8", "surrogatepass")).digest() for text in (given, expected))
    return hmac.compare_digest(first, second)


def _name(host: str) -> str:
    """Return the name in a header ``Host``, lower case, without port and brackets; empty if it is none."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
