"""Addresses of the devices of a bench: whether they are simulated, and a form that is equal for the same device."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from contextlib import suppress
from ipaddress import ip_address
from typing import Any

from errormotion.campaign.files import BenchCompensator, BenchInstrument, BenchPlan
from errormotion.errors import ErrormotionError, InstrumentError
from errormotion.instruments.transports.address import CAN, HTTP, MODBUS, OPC, Address, number_of_host, parse_address

EXEMPT = ("sim", "replay")
"""Schemes of devices that exist in one process only, and of recordings."""
LOOPBACK = "127.0.0.1"
_THIS_COMPUTER = ("localhost", "localhost.localdomain", "ip6-localhost", "::1", "0.0.0.0", "::")
_PORTS = {HTTP: 80, OPC: 4840}
_SERIAL = ("serial", "modbus+rtu")


def is_simulated(plan: BenchPlan) -> bool:
    """Return whether all devices of a bench, with its compensator, are simulated or recorded ones."""
    return all(scheme_of(url) in EXEMPT for each in devices(plan) for url in urls(each))


def devices(plan: BenchPlan) -> list[BenchInstrument | BenchCompensator]:
    """Return the instruments of a bench, and its compensator."""
    return [*plan.instruments, *([] if plan.compensator is None else [plan.compensator])]


def urls(device: BenchInstrument | BenchCompensator) -> tuple[str, ...]:
    """Return the addresses of a device; several where its driver states ``addresses``."""
    found: Any = None
    if hasattr(device.driver, "addresses"):
        with suppress(ErrormotionError):  # incomplete settings, which are reported when it is opened
            found = device.driver(device.address, device.settings).addresses
    return tuple(map(str, found.values())) if isinstance(found, Mapping) and found else (device.address,)


def scheme_of(url: str) -> str:
    """Return the scheme of an address; empty for a path or a missing address."""
    scheme, mark, _ = url.partition("://")
    return scheme if mark else ""


def is_line(url: str) -> bool:
    """Return whether an address is that of a serial line, which serves one program at a time."""
    return scheme_of(url) in _SERIAL


def same_device(url: str) -> str:
    """Return a text that is equal for all addresses of one device; empty without an address.

    The same are upper and lower case of a host, all spellings of its number, a stated default port, the names and
    numbers of this computer, the links to a serial line or a file, and parameters that do not select a device.
    Different names of another computer are not compared.
    """
    try:
        address = parse_address(url)
    except InstrumentError:  # a path, or an address of a plugin
        path = url.removeprefix("file://")
        return f"file:{os.path.realpath(os.path.expanduser(path))}" if path else ""
    if address.scheme in EXEMPT:
        return url
    if address.scheme in _SERIAL:
        return f"serial:{os.path.realpath(address.path)}"  # one program at a time, whatever the units on the line
    if address.scheme == "unix":
        return f"unix:{os.path.realpath(os.path.expanduser(address.path))}"
    if address.scheme == CAN:
        return f"can:{address.host}/{address.path}{_selected(address, 'node', '')}"
    port = address.port or _PORTS.get(address.scheme, 0)
    path = f"/{address.path}" if address.scheme == HTTP and address.path else ""
    unit = _selected(address, "unit", "1") if address.scheme in (*MODBUS, "tcp") else ""
    return f"tcp:{_host(address.host)}:{port}{path}{unit}"


def _selected(address: Address, name: str, default: str) -> str:
    """Return the parameter that selects a device on a bus; empty for the default."""
    value = address.params.get(name, default)
    with suppress(ValueError):
        value = f"{float(value):g}"
    return "" if value == default else f"#{value}"


def _host(name: str) -> str:
    name = number_of_host(name.lower().rstrip("."))
    if name in _THIS_COMPUTER or name == platform.node().lower():
        return LOOPBACK
    try:
        number = ip_address(name)
    except ValueError:
        return name
    mapped = getattr(number, "ipv4_mapped", None)
    number = number if mapped is None else mapped
    return LOOPBACK if number.is_loopback and number.version == 6 else str(number)
