"""Rules of access: names of the server, token, origin of a request."""

from __future__ import annotations

import hmac
import ipaddress
import platform
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from urllib.parse import urlsplit

LOOPBACK = "127.0.0.1"
CONTROL_HEADER = "X-Errormotion-Control"
"""Header of requests that start, stop or change something."""


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
        Secret that a browser receives in return for the token; new at every start. It is a cookie, which browsers send
        to every port of the computer: it permits to read, not to control.
    secret : str
        Secret from which the token for control is computed; new at every start.
    """

    names: frozenset[str]
    token: str = ""
    secure: bool = False
    session: str = field(default_factory=lambda: secrets.token_urlsafe(32))
    secret: str = field(default_factory=lambda: secrets.token_urlsafe(32))

    def allows_host(self, host: str) -> bool:
        """Return whether the header ``Host`` of a request names this server."""
        name = _name(host)
        return name in self.names or _is_address(name)

    def same_origin(self, origin: str | None, host: str) -> bool:
        """Return whether the header ``Origin`` is that of this server; required for requests that change something."""
        if origin is None:
            return False
        try:
            found = urlsplit(origin)
            scheme = "https" if self.secure else "http"
            return bool(host) and found.scheme == scheme and found.netloc.casefold() == host.casefold()
        except ValueError:
            return False

    def accepts_token(self, token: str) -> bool:
        """Return whether a token is valid; compared in constant time."""
        return bool(self.token) and _equal(token, self.token)

    def accepts_session(self, session: str | None) -> bool:
        """Return whether a request may read: no token is required, or its browser has presented the token."""
        return not self.token or _equal(session or "", self.session)

    def control_for(self, host: str) -> str:
        """Return the token for control that a page of a host has: a header, which no other page can send."""
        return hmac.new(self.secret.encode(), host.casefold().encode("utf-8", "replace"), sha256).hexdigest()

    def accepts_control(self, token: str | None, host: str) -> bool:
        """Return whether a request may control: its header has the token of the host that it names."""
        return _equal(token or "", self.control_for(host))

    def refusal(
        self, method: str, headers: Mapping[str, str], session: str | None, *, public: bool, controls: bool
    ) -> tuple[int, str] | None:
        """Return status and reason of the refusal of a request, by its header alone; None if it is admitted.

        Parameters
        ----------
        method : str
        headers : mapping
        session : str, optional
            Session in its cookie.
        public : bool
            Whether it needs no session.
        controls : bool
            Whether it starts, stops or changes something.
        """
        host = headers.get("Host", "")
        if not self.allows_host(host):
            return 421, "The host name is not one of this server; see --name"
        if method not in ("GET", "HEAD") and not self.same_origin(headers.get("Origin"), host):
            return 403, "The request is not from a page of this server"
        if not public and not self.accepts_session(session):
            return 403, "The token is required"
        if controls and not self.accepts_control(headers.get(CONTROL_HEADER), host):
            return 403, "The token is required again to control a machine; open the page /login"
        return None


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
