"""Rules of access: names of the server, token, origin of a request."""

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
        Host names of the server, lower case. IP addresses are always allowed: a foreign page can resolve its name to
        the address of this computer (DNS rebinding), but it cannot make a browser send an address instead.
    token : str
        Token that a browser must present once; empty if none is required.
    secure : bool
        Whether the connection is encrypted.
    session : str
        Secret that a browser receives in return for the token; new at every start.
    """

    names: frozenset[str]
    token: str = ""
    secure: bool = False
    session: str = field(default_factory=lambda: secrets.token_urlsafe(32))

    def allows_host(self, host: str) -> bool:
        """Return whether the header ``Host`` of a request names this server."""
        name = _name(host)
        return name in self.names or _is_address(name)

    def same_origin(self, origin: str | None, host: str) -> bool:
        """Return whether the header ``Origin`` is that of this server; required for requests that change something."""
        if origin is None:
            return False
        try:
            return bool(host) and urlsplit(origin).netloc.casefold() == host.casefold()
        except ValueError:
            return False

    def accepts_token(self, token: str) -> bool:
        """Return whether a token is valid; compared in constant time."""
        return bool(self.token) and _equal(token, self.token)

    def accepts_session(self, session: str | None) -> bool:
        """Return whether a request may read: no token is required, or its browser has presented the token."""
        return not self.token or _equal(session or "", self.session)


def access_for(host: str, names: Iterable[str] = (), *, secure: bool = False, control: bool = False) -> Access:
    """Return the rules of access of a server that listens on an address.

    A new token is required if other computers reach the server, or if it may start motions of a machine: every user of
    this computer can reach the loopback address.
    """
    known = {"localhost", host, platform.node(), *names}
    return Access(
        frozenset(name.casefold() for name in known if name),
        "" if is_loopback(host) and not control else secrets.token_urlsafe(24),
        secure,
    )


def is_loopback(host: str) -> bool:
    """Return whether an address can be reached from this computer only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _equal(given: str, expected: str) -> bool:
    """Compare hashes, so that the duration depends on neither length nor content."""
    first, second = (sha256(text.encode("utf-8", "surrogatepass")).digest() for text in (given, expected))
    return hmac.compare_digest(first, second)


def _name(host: str) -> str:
    """Return the name in a header ``Host``, lower case, without port and brackets; empty if it is invalid."""
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
