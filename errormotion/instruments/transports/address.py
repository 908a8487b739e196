"""Addresses of devices are URLs. They go into the provenance, so that simulated data never pass for real ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from urllib.parse import parse_qsl, urlencode, urlsplit

from errormotion.errors import InstrumentError

SCHEMES = ("serial", "tcp", "sim", "replay")
_EXAMPLES = "serial:///dev/ttyUSB0?baudrate=921600, tcp://192.168.0.2:23, sim://cframe/X1?seed=3, replay://session.rec"


@dataclass(frozen=True)
class Address:
    """A device address, taken apart.

    Attributes
    ----------
    url : str
        As written.
    scheme : str
        ``serial``, ``tcp``, ``sim`` or ``replay``.
    host : str
        Host of ``tcp``, machine of ``sim``; else empty.
    port : int or None
        TCP port.
    path : str
        Device file of ``serial``, file of ``replay``, device of ``sim``.
    params : mapping of str to str
        What follows the question mark.
    """

    url: str
    scheme: str
    host: str = ""
    port: int | None = None
    path: str = ""
    params: Mapping[str, str] = field(default_factory=dict)

    def number(self, name: str, default: float) -> float:
        """Return a parameter as a number; InstrumentError names a value that is none."""
        text = self.params.get(name)
        if text is None:
            return default
        try:
            return float(text)
        except ValueError:
            raise InstrumentError(f"'{name}' in '{self.url}': expected a number; found '{text}'") from None

    def line(self, name: str, default: int) -> Address:
        """Return the address of a further TCP line of the same device, at the port that the parameter ``name`` gives.

        Raises
        ------
        InstrumentError
            The parameter is no port number.
        """
        port = float(self.number(name, default))
        if not (port.is_integer() and 0 < port < 1 << 16):
            raise InstrumentError(f"'{name}' in '{self.url}': expected a port from 1 to 65535; found {port:g}")
        return replace(self, url=f"tcp://{self.host}:{port:.0f}", port=int(port), params={})

    def with_path(self, path: str) -> str:
        """Return the URL with another path, its parameters kept."""
        query = f"?{urlencode(self.params)}" if self.params else ""
        return f"{self.scheme}://{self.host}/{path}{query}"


def parse_address(url: str) -> Address:
    """Return a URL taken apart.

    Raises
    ------
    InstrumentError
        No known scheme, no host, port or path where one is needed, a parameter without value.
    """
    scheme, mark, rest = url.partition("://")
    if not mark or scheme not in SCHEMES:
        raise InstrumentError(f"Expected an address such as {_EXAMPLES}; found '{url}'")
    if scheme == "replay":  # the rest is a file name, with whatever characters files have
        if not rest:
            raise InstrumentError(f"'{url}' names no recording; write replay://FILE")
        return Address(url, scheme, path=rest)
    try:
        parts = urlsplit(url)
        port = parts.port
        params = dict(parse_qsl(parts.query, strict_parsing=True)) if parts.query else {}
    except ValueError as error:
        raise InstrumentError(f"The address '{url}' cannot be read: {error}; such as {_EXAMPLES}") from None
    if scheme == "tcp" and (not parts.hostname or port is None):
        raise InstrumentError(f"Expected tcp://HOST:PORT; found '{url}'")
    if scheme == "serial" and not parts.path.strip("/"):
        raise InstrumentError(f"Expected serial:///dev/NAME?baudrate=N; found '{url}'")
    path = parts.path if scheme == "serial" else parts.path.strip("/")
    return Address(url, scheme, parts.hostname or "", port, path, params)
