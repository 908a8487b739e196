"""``errormotion simulate``: starts the simulated device of an instrument or a compensator as a server."""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from errormotion import plugins
from errormotion.campaign.files import load_bench
from errormotion.cli.output import show, show_json
from errormotion.datasets.files.tomlfile import nearest
from errormotion.errors import InstrumentError, PluginError
from errormotion.instruments.simulators.virtual_world.described import NAME, describe
from errormotion.instruments.transports import load_simulator, parse_address

DEFAULT_MACHINE = "cframe"
REAL_TIME = {"pace": "1", "clock": "1"}
"""Parameters of a device that runs in real time, as other programs expect."""


def run(
    plugin_id: str,
    *,
    port: int | None,
    host: str | None,
    fault: str | None,
    bench: Path | None,
    machine: str | None,
    seed: int | None,
    settings: list[str],
    as_json: bool,
) -> None:
    """Start the device, print its addresses, and wait until Ctrl-C or SIGTERM."""
    simulator = _simulator_of(plugin_id)
    given = {"port": port, "host": host, "fault": fault, "seed": seed}
    params = {name: str(value) for name, value in given.items() if value is not None}
    address = parse_address(_address(plugin_id, bench, machine, params | _pairs(settings)))
    device = load_simulator(simulator, address.url)(address)
    try:
        _require_reachable(device.url)
        _print(plugin_id, address.url, device, as_json)
        _wait()
    except KeyboardInterrupt:  # Ctrl-C ends the command
        pass
    finally:
        device.close()


def _wait() -> None:
    threading.Event().wait()


def _simulator_of(plugin_id: str) -> str:
    groups: tuple[plugins.Group, ...] = ("instruments", "compensators")
    found = {each.id: each for group in groups for each in plugins.available(group)}
    simulated = {name: each.cls.info.simulator for name, each in found.items() if each.cls is not None}
    if simulator := simulated.get(plugin_id):
        return str(simulator)
    choices = nearest(plugin_id, [name for name, simulator in simulated.items() if simulator])
    if plugin_id in found:
        group = found[plugin_id].group
        plugins.get(group, plugin_id)  # raises the reason if the plugin cannot be loaded
        raise PluginError(
            f"The {group.rstrip('s')} '{plugin_id}' has no simulator of its own. {choices}", code="simulator.missing"
        )
    raise PluginError(
        f"Expected an instrument or a compensator that can be simulated; found '{plugin_id}'. {choices}",
        code="plugin.unknown",
    )


def _pairs(settings: list[str]) -> dict[str, str]:
    pairs = [text.partition("=") for text in settings]
    if wrong := [name for name, mark, value in pairs if not (name and mark and value)]:
        raise InstrumentError(f"--set {wrong[0]}: expected KEY=VALUE, such as fault_at=10", code="option.form")
    return {name: value for name, _, value in pairs}


def _address(plugin_id: str, bench: Path | None, machine: str | None, params: dict[str, str]) -> str:
    """Return the ``sim://`` address of the bench file for this instrument, changed by the options."""
    host, path, found = DEFAULT_MACHINE, "", dict[str, str]()
    if bench is not None:
        plan = load_bench(bench)
        if plan.description is not None:
            describe(plan.description)
            host = NAME
        own = [each.address for each in plan.instruments if each.driver.info.id == plugin_id]
        if plan.compensator is not None and plan.compensator.driver.info.id == plugin_id:
            own.append(plan.compensator.address)
        addresses = [each for each in own if each.startswith("sim://")]
        if addresses:
            first = parse_address(addresses[0])
            host, path, found = first.host or host, first.path, dict(first.params)
    query = urlencode(REAL_TIME | found | params)
    return f"sim://{machine or host}/{path}?{query}"


def _require_reachable(url: str) -> None:
    if url.startswith("can://virtual/"):
        raise InstrumentError(
            f"The simulated device uses a CAN bus inside this process, {url}; choose a bus that other processes reach, "
            "such as --set bus=udp_multicast",
            code="simulator.bus.inside",
        )


def _print(plugin_id: str, simulator: str, device: Any, as_json: bool) -> None:
    lines = dict(getattr(device, "urls", {}))
    address = _driver_address(device, lines)
    if as_json:
        settings = dict(getattr(device, "driver_settings", {}))
        where = {"address": address, "url": device.url, "lines": lines, "settings": settings}
        show_json({"ok": True, "plugin": plugin_id, "simulator": simulator, **where})
        sys.stdout.flush()
        return
    show(f"{plugin_id}: {address or device.url}")
    for name, url in lines.items():
        show(f"{name}: {url}")
    for name, value in getattr(device, "driver_settings", {}).items():
        show(f"{name} = {json.dumps(value)}")  # as in a bench file
    show("Ctrl-C ends it.")


def _driver_address(device: Any, lines: Mapping[str, str]) -> str:
    """Return the address of the device in a bench file; empty if its lines have no common address."""
    stated = getattr(device, "driver_url", None)
    if stated is not None:
        return str(stated)
    if not lines:
        return str(device.url)
    found = [parse_address(url) for url in (device.url, *lines.values())]
    if any(each.scheme != "tcp" for each in found):
        return ""
    return f"{device.url}?{urlencode({name: each.port for name, each in zip(lines, found[1:], strict=True)})}"
