"""``errormotion simulate``: the simulated device of an instrument plugin, by itself."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from urllib.parse import urlencode

from errormotion import plugins
from errormotion.campaign.files import load_bench
from errormotion.cli.commands.plugins import group_of
from errormotion.cli.output import show, show_json
from errormotion.errors import InstrumentError, PluginError
from errormotion.instruments.simulators.virtual_world.described import NAME, describe
from errormotion.instruments.transports import load_simulator, parse_address

DEFAULT_MACHINE = "cframe"
REAL_TIME = {"pace": "1", "clock": "1"}
"""Other programs expect a device with the clock of this computer."""


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
        lines = {"": device.url} | dict(getattr(device, "urls", {}))
        _require_reachable(lines[""])
        _print(plugin_id, address.url, lines, as_json)
        _wait()
    except KeyboardInterrupt:  # the way to end it
        pass
    finally:
        device.close()


def _wait() -> None:
    threading.Event().wait()


def _simulator_of(plugin_id: str) -> str:
    group = group_of(plugin_id)
    if group != "instruments":
        raise PluginError(f"'{plugin_id}' is a plugin of the group {group}; expected an instrument")
    simulator = plugins.get(group, plugin_id).info.simulator
    if simulator is None:
        raise PluginError(f"The instrument '{plugin_id}' has no simulator of its own")
    return str(simulator)


def _pairs(settings: list[str]) -> dict[str, str]:
    pairs = [text.partition("=") for text in settings]
    if wrong := [name for name, mark, value in pairs if not (name and mark and value)]:
        raise InstrumentError(f"--set {wrong[0]}: expected KEY=VALUE, such as fault_at=10")
    return {name: value for name, _, value in pairs}


def _address(plugin_id: str, bench: Path | None, machine: str | None, params: dict[str, str]) -> str:
    """Return the ``sim://`` address: that of the bench file for this instrument, with what was given instead."""
    host, path, found = DEFAULT_MACHINE, "", dict[str, str]()
    if bench is not None:
        plan = load_bench(bench)
        if plan.description is not None:
            describe(plan.description)
            host = NAME
        own = [each.address for each in plan.instruments if each.driver.info.id == plugin_id]
        addresses = [each for each in own if each.startswith("sim://")]
        if addresses:
            first = parse_address(addresses[0])
            host, path, found = first.host or host, first.path, dict(first.params)
    query = urlencode(REAL_TIME | found | params)
    return f"sim://{machine or host}/{path}?{query}"


def _require_reachable(url: str) -> None:
    if url.startswith("can://virtual/"):
        raise InstrumentError(
            f"The simulated device is on a CAN bus inside this process, {url}; put it on one that other processes "
            "reach, such as --set bus=udp_multicast"
        )


def _print(plugin_id: str, address: str, lines: dict[str, str], as_json: bool) -> None:
    if as_json:
        further = {name: url for name, url in lines.items() if name}
        show_json({"ok": True, "plugin": plugin_id, "simulator": address, "url": lines[""], "lines": further})
        sys.stdout.flush()
        return
    for name, url in lines.items():
        show(f"{name or plugin_id}: {url}")
    show("Ctrl-C ends it.")
