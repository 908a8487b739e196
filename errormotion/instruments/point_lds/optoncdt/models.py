"""Facts of the sensor families, with the page of the manufacturer's manual for each.

2300: *optoNCDT 2300 Instruction Manual*; 1420: *optoNCDT 1420 Instruction Manual*. Facts without a page are marked (m).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from errormotion.errors import InstrumentError


@dataclass(frozen=True)
class Model:
    """A sensor family.

    Attributes
    ----------
    name : str
        Start of the name that GETINFO reports.
    rates : mapping of float to str
        Measuring rates, Hz, with the parameter of MEASRATE for each.
    ranges : tuple of float
        Measuring ranges, m.
    baudrates : tuple of int
    highest : int
        Last raw value of the measuring range.
    synchronises : bool
        Whether the sensor has the command SYNC.
    cleared : tuple of str
        Commands that reset settings of an earlier user which would change the values or their sequence;
        ``{termination}`` stands for the line termination that the sensor reports for this command.
    optional : tuple of str
        Commands for the same purpose whose grammar is not documented for this family. They are sent where the sensor
        states another value, or none; a refusal is noted only if the sensor refuses to state the setting, too.
    """

    name: str
    rates: Mapping[float, str]
    ranges: tuple[float, ...]
    baudrates: tuple[int, ...]
    highest: int
    synchronises: bool
    cleared: tuple[str, ...]
    optional: tuple[str, ...]

    def rate_word(self, rate: float) -> str:
        """Return the parameter of MEASRATE for a rate, Hz; InstrumentError if the family has no such rate."""
        for known, word in self.rates.items():
            if math.isclose(rate, known, rel_tol=1e-6):
                return word
        known_rates = ", ".join(f"{known / 1000:g}" for known in self.rates)
        raise InstrumentError(
            f"the {self.name} measures at {known_rates} kHz; found {rate / 1000:g} kHz", code="sensor.rate.unknown"
        )


MODELS: Mapping[str, Model] = {
    "ILD1420": Model(
        name="ILD1420",
        # 8 kHz: newer sensors only (accepted by an ILD1420-50, project dawbarton/helic-daq); older ones refuse it.
        rates={250.0: "0.25", 500.0: "0.5", 1000.0: "1", 2000.0: "2", 4000.0: "4", 8000.0: "8"},
        ranges=(10e-3, 25e-3, 50e-3, 100e-3, 200e-3, 500e-3),  # 1420 p. 65
        # 1420 p. 84 and 116: 9.6 kBaud to 1 MBaud; the intermediate steps: (m)
        baudrates=(9600, 19200, 38400, 56000, 115200, 128000, 230400, 256000, 460800, 691200, 921600, 1000000),
        highest=64877,  # 1420 p. 65
        synchronises=False,  # not in the overview of commands, 1420 p. 94 ff.
        cleared=("MASTERMV NONE", "OUTREDUCEDEVICE NONE", "OUTHOLD NONE"),  # 1420 p. 108, 109
        optional=("TRIGGER NONE", "AVERAGE NONE", "LASERPOW FULL"),
    ),
    "ILD2300": Model(
        name="ILD2300",
        # 2300 p. 136. MEASRATE 49 is 49.140 kHz (2300 p. 98), with a reduced measuring range.
        rates={
            1500.0: "1.5",
            2500.0: "2.5",
            5000.0: "5",
            10000.0: "10",
            20000.0: "20",
            30000.0: "30",
            49140.0: "49",
        },
        ranges=(2e-3, 5e-3, 10e-3, 20e-3, 40e-3, 50e-3, 100e-3, 200e-3, 300e-3),  # (m)
        baudrates=(9600, 115200, 230400, 460800, 691200, 921600, 1500000, 2000000, 2500000, 3000000, 3500000, 4000000),
        highest=64876,  # 2300 p. 94
        synchronises=True,  # 2300 p. 128
        # 2300 p. 140, 139, 143, 142, German edition p. 131
        cleared=(
            "MASTERMV NONE",
            "AVERAGE NONE",
            "OUTSTATISTIC_RS422 NONE",
            "OUTDIST_RS422 DIST1",
            "TRIGGER NONE {termination}",
        ),
        optional=("OUTREDUCE 1", "OUTHOLD NONE", "LASERPOW FULL"),
    ),
}
