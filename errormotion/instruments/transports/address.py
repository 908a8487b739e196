"""Addresses of devices: URLs. The provenance of results contains them, which identifies simulated data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from socket import inet_aton, inet_ntoa
from urllib.parse import parse_qsl, urlencode, urlsplit

from errormotion.errors import InstrumentError

BYTES = ("serial", "tcp", "unix", "sim", "replay")
"""Schemes of a plain stream of bytes; the others are buses with frames."""
MODBUS = ("modbus+tcp", "modbus+rtu", "modbus+rtu-tcp")
CAN = "can"
HTTP = "http"
OPC = "opc.tcp"
SCHEMES = (*BYTES, *MODBUS, CAN, HTTP, OPC)
MODBUS_PORT = 502
_EXAMPLES = "serial:///dev/ttyUSB0?baudrate=921600, tcp://192.168.0.2:23, sim://cframe/X1?seed=3, replay://session.rec"
_FORMS = {
    "tcp": "tcp://HOST:PORT",
    "serial": "serial:///dev/NAME?baudrate=N",
    "modbus+tcp": "modbus+tcp://HOST:502?unit=1",
    "modbus+rtu-tcp": "modbus+rtu-tcp://HOST:PORT?unit=1",
    "modbus+rtu": "modbus+rtu:///dev/NAME?baudrate=9600&unit=1",
    "can": "can://INTERFACE/CHANNEL?node=5",
    "http": "http://HOST:PORT/PATH",
    "opc.tcp": "opc.tcp://HOST:4840/PATH",
}


@dataclass(frozen=True)
class Address:
    """The parts of a device address.

    Attributes
    ----------
    url : str
        The complete address.
    scheme : str
        One of ``SCHEMES``.
    host : str
        Host of a TCP connection, machine of ``sim``, interface of ``can``; else empty.
    port : int or None
        TCP port.
    path : str
        Device file of a serial line, file of ``unix`` and ``replay``, device of ``sim``, channel of ``can``.
    params : mapping of str to str
        Parameters after the question mark.
    """

    url: str
    scheme: str
    host: str = ""
    port: int | None = None
    path: str = ""
    params: Mapping[str, str] = field(default_factory=dict)

    def number(self, name: str, default: float) -> float:
        """Return a parameter as a number; InstrumentError for another value."""
        text = self.params.get(name)
        if text is None:
            return default
        try:
            return float(text)
        except ValueError:
            raise InstrumentError(
                f"'{name}' in '{self.url}': expected a number; found '{text}'", code="address.number"
            ) from None

    def line(self, name: str, default: int) -> Address:
        """Return the address of a further TCP line of the same device, at the port in the parameter ``name``.

        Raises
        ------
        InstrumentError
            The parameter is not a port number.
        """
        port = float(self.number(name, default))
        if not (port.is_integer() and 0 < port < 1 << 16):
            raise InstrumentError(
                f"'{name}' in '{self.url}': expected a port from 1 to 65535; found {port:g}", code="address.number"
            )
        return replace(self, url=f"tcp://{self.host}:{port:.0f}", port=int(port), params={})

    def whole(self, name: str, default: int, most: int) -> int:
        """Return a parameter as a whole number from 0 to ``most``; InstrumentError for another value."""
        value = float(self.number(name, default))
        if not (value.is_integer() and 0 <= value <= most):
            raise InstrumentError(
                f"'{name}' in '{self.url}': expected a number from 0 to {most}; found {value:g}", code="address.number"
            )
        return int(value)

    def with_path(self, path: str) -> str:
        """Return the URL with another path and the same parameters."""
        query = f"?{urlencode(self.params)}" if self.params else ""
        return f"{self.scheme}://{self.host}/{path}{query}"


def number_of_host(name: str) -> str:
    """Return the IPv4 address that a host states in any of its spellings, such as 10.1 for 10.0.0.1; else the name."""
    try:
        return inet_ntoa(inet_aton(name)) if name and " " not in name else name
    except OSError:
        return name


def parse_address(url: str) -> Address:
    """Return the parts of a URL.

    Raises
    ------
    InstrumentError
        Unknown scheme, a required host, port or path is missing, a parameter has no value, or it has a password.
    """
    scheme, mark, rest = url.partition("://")
    if not mark or scheme not in SCHEMES:
        near = get_close_matches(scheme.lower(), SCHEMES, n=1) if mark else []
        hint = f"; did you mean {near[0]}://{rest}?" if near else ""
        raise InstrumentError(f"Expected an address such as {_EXAMPLES}; found '{url}'{hint}", code="address.form")
    if scheme == "replay":  # the rest is a file name; it may contain any characters
        if not rest:
            raise InstrumentError(
                f"Expected the file of a recording, as in replay://FILE; found '{url}'", code="address.form"
            )
        return Address(url, scheme, path=rest)
    if scheme == "unix":  # likewise
        if not rest.startswith(("/", "~/")):
            raise InstrumentError(f"Expected unix:///FOLDER/FILE or unix://~/FILE; found '{url}'", code="address.form")
        return Address(url, scheme, path=rest)
    try:
        parts = urlsplit(url)
        port = parts.port
        params = dict(parse_qsl(parts.query, strict_parsing=True)) if parts.query else {}
    except ValueError as error:
        raise InstrumentError(
            f"The address '{url}' cannot be read: {error}; expected an address such as {_EXAMPLES}", code="address.form"
        ) from None
    if "@" in parts.netloc:  # it would be stored in recordings, runs and reports
        raise InstrumentError(
            f"Expected an address without a user name and password, which no driver sends, as in {scheme}://"
            f"{parts.netloc.rpartition('@')[2]}; found one with '@'",
            code="address.password",
        )
    serial = scheme in ("serial", "modbus+rtu")
    path = parts.path if serial else parts.path.removeprefix("/") if scheme == CAN else parts.path.strip("/")
    if scheme == "modbus+tcp" and port is None:
        port = MODBUS_PORT
    needed = {"tcp": parts.hostname and port is not None, "can": parts.hostname and path, "http": parts.hostname}
    needed[OPC] = parts.hostname
    needed["modbus+tcp"] = needed["modbus+rtu-tcp"] = needed["tcp"]
    if not (path.strip("/") if serial else needed.get(scheme, True)):
        raise InstrumentError(f"Expected {_FORMS[scheme]}; found '{url}'", code="address.form")
    return Address(url, scheme, parts.hostname or "", port, path, params)
