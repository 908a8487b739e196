"""A compensation of the real LinuxCNC whose thermometer drifts, jumps and falls silent.

Arguments: address and token file of the bridge, route, folder of the runs. It runs until it is stopped.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from linuxcnc_watch import DRIVERS

from errormotion.campaign.compensation.compensating import Compensation
from errormotion.campaign.files import BenchCompensator, BenchInstrument, parse_bench
from errormotion.compensation.online.settings import Limits
from errormotion.compensation.thermal_model import ThermalModel
from errormotion.compensation.thermal_model.features import Feature
from errormotion.compensation.thermal_model.model import Parts
from errormotion.errors import InstrumentError
from errormotion.instruments.compensator.linuxcnc import LinuxCNCCompensatorSettings
from errormotion.plugins import Identity, InstrumentInfo, PluginSettings

SPEEDUP = 20.0
"""All times of the default limits are shorter by it, and the slew limit is higher."""
LIMITS = Limits(limit=20e-6, slew=SPEEDUP * 1e-6, period=1 / SPEEDUP, oldest=0.5, hold=1.0, settle=0.5)
MACHINE = "Mill 5"
SENSITIVITY = 5e-6  # m/K
RANGE = 8.0  # K, of the training


class Thermometer:
    """A drift of 4 K with a period of a minute, a step of 2 K every 7 s, and silence for 2 s in 23 s."""

    info = InstrumentInfo("drifting_thermometer", "thermometer", "drifts, jumps and falls silent", "simulated_only")
    Settings = PluginSettings
    channels = ("spindle",)

    def __init__(self, address: str, settings: Any) -> None:
        del address, settings

    def open(self) -> None:
        """Do nothing."""

    close = open

    def identify(self) -> Identity:
        """Return what it is."""
        return Identity("tests", "thermometer", "1", simulated=True)

    def read(self) -> dict[str, float]:
        """Return the temperature now."""
        now = time.time()
        if now % 23.0 > 21.0:
            raise InstrumentError("silent")
        return {"spindle": 20.0 + 4.0 * math.sin(2 * math.pi * now / 60.0) + 2.0 * (int(now / 7.0) % 2)}


def model() -> ThermalModel:
    """Return a model whose EX is proportional to the temperature."""
    coefficient = np.zeros((6, 1))
    coefficient[0] = SENSITIVITY
    parts = Parts(
        (Feature("spindle"),),
        coefficient,
        np.full((6, 1, 1), 1e-16),
        np.full(6, 1e-7),
        np.ones(6),
        np.ones(6),
        np.array([-RANGE]),
        np.array([RANGE]),
    )
    attrs = {
        "component": "spindle",
        "frame": "machine",
        "machine": MACHINE,
        "reference": "start",
        "functional_point": [0.0, 0.0, 0.0],
        "variant": "lagged",
    }
    return ThermalModel.of(parts, attrs, {})


def main(address: str, token: str, route: str, runs: str) -> None:
    """Follow; print each change of the state."""
    head = f'schema = "errormotion.bench/1"\nname = "Shop"\nmachine = "{MACHINE}"\n'
    settings = LinuxCNCCompensatorSettings(token_file=Path(token), timeout=0.2)
    plan = replace(
        parse_bench(head, Path("bench.toml")),
        instruments=(BenchInstrument("thermometer", Thermometer, "", PluginSettings()),),
        compensator=BenchCompensator(DRIVERS[route], address, settings, LIMITS),
    )
    state = ""
    with Compensation(plan, model().dataset, Path(runs), arm=MACHINE) as compensation:
        for moment in compensation.follow():
            if str(moment.step.state) != state:
                state = str(moment.step.state)
                print(state, moment.step.cause, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
