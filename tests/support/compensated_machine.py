"""A machine for the page Compensate: a simulated PLC, a thermometer, a bench and a model."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from errormotion.compensation.thermal_model import ThermalModel
from errormotion.compensation.thermal_model.features import Feature
from errormotion.compensation.thermal_model.model import Parts
from errormotion.instruments.simulators.compensator.plc import SimulatedPlc
from errormotion.instruments.transports import parse_address

MACHINE = "Mill 5"
SENSOR = "spindle front"
BENCH = """\
schema = "errormotion.bench/1"
name = "Shop"
machine = "{machine}"
[instruments.thermometer]
driver = "dcon_temperature"
address = "sim://cframe/thermometer?seed=3&sensors=spindle_front"
channels = ["{sensor}"]
[compensator]
driver = "modbus_registers"
address = "{address}"
{settings}
[compensator.limits]
period = "0.2 s"
slew = "20 um/s"
hold = "1 s"
"""


@dataclass
class Place:
    """Folder with bench and model, and the PLC."""

    folder: Path
    plc: SimulatedPlc

    @property
    def runs(self) -> Path:
        """Folder of the runs."""
        return self.folder / "runs"


@contextmanager
def machine(folder: Path) -> Iterator[Place]:
    """Make the files, and serve the PLC."""
    with closing(SimulatedPlc(parse_address("sim://cframe/plc?slew=20e-6&watchdog=3"))) as plc:
        settings = "\n".join(f"{name} = {_toml(value)}" for name, value in plc.driver_settings.items())
        text = BENCH.format(machine=MACHINE, sensor=SENSOR, address=plc.driver_url, settings=settings)
        (folder / "bench.toml").write_text(text, encoding="utf-8")
        model(folder / "model.nc")
        (folder / "runs").mkdir()
        yield Place(folder, plc)


def model(path: Path) -> None:
    """Write a model: EX changes by 1 mm for 1 K, so that the noise of the thermometer moves the offset."""
    coefficient = np.zeros((6, 1))
    coefficient[0] = 1e-3
    parts = Parts(
        (Feature(SENSOR),), coefficient, np.zeros((6, 1, 1)), np.full(6, 1e-7), np.ones(6), np.ones(6),
        np.array([-50.0]), np.array([50.0]),
    )  # fmt: skip
    attrs: dict[str, Any] = {"component": "spindle", "frame": "machine", "machine": MACHINE, "reference": "start"}
    ThermalModel.of(parts, {**attrs, "functional_point": [0.0, 0.0, 0.0], "variant": "lagged"}, {}).save(path)


def _toml(value: object) -> str:
    return str(list(value)) if isinstance(value, tuple) else repr(value).replace("'", '"')
