"""Online compensation: time of a prediction and of a cycle of reading and writing, for each output.

For comparison, the time of a plain client of the same protocol for the same reads and writes. The machines are
simulated in this process; a connection or a control adds its own time.

``python benchmarks/compensation.py [HOURS [SEED]]``: also this number of simulated hours of compensation with a
simulated PLC and a fault every 10 minutes.
"""

import asyncio
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
from pymodbus.client import ModbusTcpClient

from errormotion import plugins
from errormotion.compensation.online.prediction import predictor
from errormotion.compensation.thermal_model import ThermalModelSettings, fit
from errormotion.errors import InstrumentError
from errormotion.instruments.transports import load_simulator, parse_address
from errormotion.testing.run import subjects_of
from errormotion.twin import Event, VirtualMachine

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

CYCLES = 1000
WANTED = 5e-3
"""s"""
LIMIT = 50e-6
OFF = {"X": False, "Y": False, "Z": False}


def timed(cycle: Callable[[int], object], cycles: int = CYCLES) -> str:
    """Run cycles; return their median, 99 % and largest time as text."""
    for k in range(20):
        cycle(k)
    times = []
    for k in range(cycles):
        start = time.perf_counter()
        cycle(k)
        times.append(time.perf_counter() - start)
    worst = statistics.quantiles(times, n=100)[98]
    verdict = "within" if worst < WANTED else "outside"
    median, longest = statistics.median(times), max(times)
    return f"{1e3 * median:6.2f} {1e3 * worst:8.2f} {1e3 * longest:8.2f} ms   99 % {verdict} {1e3 * WANTED:g} ms"


def prediction() -> Callable[[int], object]:
    """Return a function that predicts from readings of five temperatures."""
    machine, warm_ups = VirtualMachine("cframe", seed=3), []
    for speeds in ([(0, 6000), (3600, 12000), (7200, 0)], [(0, 15000), (2400, 3000), (6000, 9000)]):
        machine.start([Event(at, speed, OFF if at == 0 else None) for at, speed in speeds])
        warm_ups.append(machine.truth_spindle(np.arange(0.0, 10801.0, 360.0)))
    found = predictor(fit(warm_ups, ThermalModelSettings(variant="lagged")).dataset)
    names, clock = found.temperatures, iter(range(1 << 30))
    rng = np.random.default_rng(1)
    return lambda _: found.update(
        float(next(clock)), dict(zip(names, 20 + rng.normal(0, 0.1, len(names)), strict=True)), {}
    )


def outputs(predict: Callable[[int], object]) -> None:
    """Print the time of a cycle of each compensator with a simulated machine in this process."""
    for plugin in plugins.available("compensators"):
        cls = plugin.cls
        if cls is None or not cls.info.simulator:
            print(f"{plugin.id:24} has no simulated machine")
            continue
        address = parse_address(subjects_of("compensators", plugin.id)[0].address)
        try:
            made = load_simulator(cls.info.simulator, address.url)(address)
        except InstrumentError as error:
            print(f"{plugin.id:24} {error}")
            continue
        with closing(made) as device:
            where = getattr(device, "driver_url", None) or device.url
            with closing(cls(where, cls.Settings(**device.driver_settings))) as compensator:
                compensator.open()
                compensator.arm(LIMIT)

                def cycle(k: int, compensator=compensator) -> None:
                    predict(k)
                    compensator.read()
                    compensator.write((1e-8 * (k % 100), 0.0, -1e-8 * (k % 100)))

                print(f"{plugin.id:24} {timed(cycle)}")


def modbus_client() -> None:
    """Print the time of the same requests by the client of pymodbus."""
    address = parse_address("sim://cframe/plc?slew=1e-3")
    simulator = "errormotion.instruments.simulators.compensator.plc:SimulatedPlc"
    with (
        closing(load_simulator(simulator, address.url)(address)) as device,
        ModbusTcpClient("127.0.0.1", port=parse_address(device.url).port) as client,
    ):

        def cycle(k: int) -> None:
            read = client.read_holding_registers(7, count=8, device_id=1)
            written = client.write_registers(0, [0, k % 100, 0, 0, 0, 0, k % 65536], device_id=1)
            assert not read.isError()
            assert not written.isError()

        print(f"{'  pymodbus alone':24} {timed(cycle)}")
        assert device.machine.orders > CYCLES


def opcua_client() -> None:
    """Print the time of the same requests by the client of asyncua, without threads."""
    from asyncua import Client, ua

    address = parse_address("sim://cframe/nodes?slew=1e-3")
    simulator = "errormotion.instruments.simulators.compensator.nodes:SimulatedNodes"
    with closing(load_simulator(simulator, address.url)(address)) as device, asyncio.Runner() as runner:
        client = Client(device.url)
        runner.run(client.connect())
        settings = device.driver_settings
        read = [client.get_node(each) for each in (*settings["applied"], settings["stop"], settings["busy"])]
        nodes = [ua.NodeId.from_string(each) for each in (*settings["offset"], settings["heartbeat"])]

        async def exchange(k: int) -> None:
            await client.read_attributes(read)
            values = [ua.Variant(1e-5 * (k % 100), ua.VariantType.Double)] * 3 + [ua.Variant(k, ua.VariantType.UInt32)]
            await client.uaclient.write_attributes(nodes, [ua.DataValue(each, StatusCode=None) for each in values])

        print(f"{'  asyncua alone':24} {timed(lambda k: runner.run(exchange(k)))}")
        runner.run(client.disconnect())


def bare_file() -> None:
    """Print the time of the replacement of a file."""
    with tempfile.TemporaryDirectory() as folder:
        new, target = Path(folder) / "new", Path(folder) / "offset.json"

        def cycle(k: int) -> None:
            with suppress(FileNotFoundError):
                target.read_text()
            new.write_text(f'{{"X": {k}}}')
            new.replace(target)

        print(f"{'  a file alone':24} {timed(cycle)}")


def hours_with_faults(hours: float, seed: int) -> None:
    """Print the extremes of simulated hours with a fault every 10 minutes."""
    from compensated_hours import LIMITS, SLEW, follow, limits_kept

    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_STATE_HOME"] = folder
        found = follow(Path(folder), hours, 600.0, seed)
    print(f"{found.hours:.1f} h, seed {seed}: {found.rows} decisions, {found.orders} orders, {found.starts} starts")
    print(f"  faults: {dict(found.faults)}")
    print(f"  states: {dict(found.states)}")
    print(f"  in effect: {found.largest * 1e6:.3f} um (limit {LIMITS.limit * 1e6:g}),", end=" ")
    print(f"{found.fastest * 1e6:.3f} um/s (limit of the PLC {SLEW * 1e6:g})")
    print(f"  ordered: {found.largest_order * 1e6:.3f} um, {found.longest_step:.3f} periods at the slew limit (2)")
    print(f"  beyond a limit: {', '.join(limits_kept(found)) or 'nothing'}")


def main() -> None:
    busy, cores = os.getloadavg()[0], os.cpu_count()
    print(f"{CYCLES} cycles of one reading and one write each; load of this computer {busy:.1f} on {cores} cores")
    print(f"{'':24} median     99 %  longest")
    predict = prediction()
    print(f"{'prediction':24} {timed(predict)}")
    outputs(predict)
    bare_file()
    modbus_client()
    with suppress(ImportError):
        opcua_client()
    if len(sys.argv) > 1:
        hours_with_faults(float(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1)


if __name__ == "__main__":
    sys.exit(main())
