"""A compensation that is killed: it writes to a simulated PLC over TCP, which notes every order and goes on.

A kill is survived when every order that arrived stands in the audit log, whose chain is valid up to its last entry;
the PLC ramps to zero; and the program that is started next goes on from the offset that the PLC then has.
"""

import json
import math
import random
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import fault_trials as trials
import numpy as np
from fault_processes import Forked

from errormotion.campaign.compensation.compensating import AUDIT
from errormotion.campaign.files import load_bench
from errormotion.campaign.folder import list_runs
from errormotion.campaign.monitor.watch import Monitor
from errormotion.compensation.online.audit import verify
from errormotion.compensation.online.follower import MAX_STEP
from errormotion.compensation.thermal_model import ThermalModel
from errormotion.compensation.thermal_model.features import Feature
from errormotion.compensation.thermal_model.model import Parts
from errormotion.errors import ErrormotionError
from errormotion.instruments.simulators.compensator.plc import SimulatedPlc
from errormotion.instruments.transports import parse_address

PERIOD, SLEW, LIMIT = 0.05, 20e-6, 20e-6
"""Of the program: s, m/s, m."""
WATCHDOG, OWN_SLEW = 30.0, 40e-6
"""Of the PLC: s, so long that a busy computer does not meet it, and m/s."""
SENSITIVITY, NOISE = 20e-6, 0.5
"""Errors by temperature, m/K, and noise of the temperature, K: the offset always moves."""
ROUNDING = 1e-9
"""Resolution of the registers, m."""
BENCH = """schema = "errormotion.bench/1"
name = "Shop"
machine = "{machine}"
[instruments.thermometer]
driver = "dcon_temperature"
address = "sim://cframe/thermometer?seed={seed}&sensors=head&noise={noise}"
channels = ["head"]
[compensator]
driver = "modbus_registers"
address = "{address}"
{registers}
[compensator.limits]
period = "{period} s"
slew = "{slew} um/s"
limit = "{limit} um"
oldest = "20 s"
hold = "20 s"
"""

Order = tuple[float, float, float]


@contextmanager
def plc() -> Iterator[tuple[SimulatedPlc, list[Order]]]:
    """Run a PLC whose orders are noted."""
    address = f"sim://cframe/plc?watchdog={WATCHDOG}&slew={OWN_SLEW}&limit={LIMIT}"
    device, orders, lock = SimulatedPlc(parse_address(address)), list[Order](), threading.Lock()
    take = device.machine.order

    def noted(offset: Sequence[float], *, alive: bool = True) -> None:
        with lock:
            orders.append((offset[0], offset[1], offset[2]))
        take(offset, alive=alive)

    device.machine.order = noted  # type: ignore[method-assign]
    try:
        yield device, orders
    finally:
        device.close()


def prepare(place: Path, device: SimulatedPlc, seed: int) -> list[Any]:
    """Write a bench and a model into a folder, and return the words of the command without ``--runs``."""
    machine = f"Mill {place.name}"  # of each trial its own: one machine has one compensation
    registers = "\n".join(f"{key} = {json.dumps(value)}" for key, value in device.driver_settings.items())
    bench, model = place / "bench.toml", place / "model.nc"
    bench.write_text(
        BENCH.format(machine=machine, seed=seed, noise=NOISE, address=device.driver_url, registers=registers,
                     period=PERIOD, slew=1e6 * SLEW, limit=1e6 * LIMIT), encoding="utf-8"
    )  # fmt: skip
    (sensor,) = Monitor(load_bench(bench), place / "runs").sensors
    coefficient = np.zeros((6, 1))
    coefficient[0], coefficient[1] = SENSITIVITY, -SENSITIVITY / 2
    one, ends = np.ones(6), (np.array([-50.0]), np.array([50.0]))
    parts = Parts((Feature(sensor),), coefficient, np.zeros((6, 1, 1)), np.full(6, 1e-7), one, one, *ends)
    attrs = {"component": "spindle", "frame": "machine", "machine": machine, "reference": "start"}
    ThermalModel.of(parts, {**attrs, "functional_point": [0.0, 0.0, 0.0], "variant": "lagged"}, {}).save(model)
    return ["compensate", "run", bench, "--model", model, "--arm", machine]


def kill(chance: random.Random, place: Path, runs: Path, journal: Path) -> tuple[trials.Ended, list[str]]:
    """Kill a compensation, and start it again; return what the kill left, and what must not be."""
    with plc() as (device, orders):
        words = [*prepare(place, device, chance.randrange(1000)), "--runs", runs]
        process = Forked(words, journal)
        begun = chance.random() < 0.2
        ready = (lambda: bool(list_runs(runs))) if begun else (lambda: len(orders) > 0)
        instant = trials.kill_when(process, ready, chance.uniform(0.0, 0.2 if begun else 2.5))
        ended = trials.examined(runs, journal, instant)
        found = [*ended.faults, *_course(orders, (0.0, 0.0, 0.0))]
        if not begun and not any(any(order) for order in orders):
            found.append(f"the offset never moved in {len(orders)} orders")
        killed = list_runs(runs)
        if chance.random() < 0.5:
            device.machine.elapse(WATCHDOG + LIMIT / OWN_SLEW + 1.0)
            if any(device.machine.offset):
                found.append(f"without a sign of life the machine has the offset {device.machine.offset}")
        start, count = device.machine.offset, len(orders)
        more = ["--since", killed[0].path] if killed and _rows(killed[0].raw) and chance.random() < 0.5 else []
        again = trials.finish(Forked([*words, "--duration", "1 s", *more], journal.with_name("again")))
        found += again.faults
        if again.code:
            found.append(f"the next compensation ended with {again.code}: {again.message[-300:]}")
        elif len(orders) == count or any(orders[-1]):
            found.append(f"the next compensation sent {len(orders) - count} orders, the last of which is not zero")
        found += _course(orders[count:], start)
        found += _audited(runs, orders)
    return ended, found


def _rows(raw: Path) -> int:
    from errormotion import datasets

    if not (raw / "zarr.json").exists():
        return 0
    with datasets.load(raw) as found:
        return int(found.sizes["time"])


def _course(orders: Sequence[Order], start: Order) -> list[str]:
    """Return what is wrong with the orders of one program: beyond the limit, or a step that the slew limit forbids."""
    course = np.array([start, *orders])
    steps = np.abs(np.diff(course, axis=0)).max(initial=0.0)
    most = MAX_STEP * SLEW * PERIOD + 2 * ROUNDING
    found = [f"a step of {1e6 * steps:.3f} um, limit {1e6 * most:.3f} um"] if steps > most else []
    largest = np.abs(course).max(initial=0.0)
    return found + ([f"an order of {1e6 * largest:.3f} um"] if largest > LIMIT + ROUNDING else [])


def _audited(runs: Path, orders: Sequence[Order]) -> list[str]:
    """Return what is wrong with the audit logs of all run folders: their chains, and orders that none states."""
    found, stated = [], []
    for folder in list_runs(runs):
        path = folder.path / AUDIT
        if not path.exists():
            continue
        try:
            verify(path)
        except ErrormotionError as error:
            found.append(str(error))
            continue
        entries = [json.loads(line)["entry"] for line in path.read_text(encoding="utf-8").splitlines()]
        stated += [entry["offset"] for entry in entries if "offset" in entry]
    known = np.array(stated, dtype=float).reshape(-1, 3)
    for order in set(orders):
        if not known.size or np.abs(known - order).max(axis=1).min(initial=math.inf) > ROUNDING:
            found.append(f"the order {order} is not in an audit log")
    return found
