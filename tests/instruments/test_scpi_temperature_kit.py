"""The conformance kit on SCPI data acquisition units, with the simulated unit where it is installed."""

from importlib.util import find_spec

from errormotion.instruments.thermometer.scpi.driver import ScpiTemperature
from errormotion.testing import InstrumentConformance, InstrumentSubject

SIMULATOR = ScpiTemperature.info.simulator.partition(":")[0]

if find_spec(SIMULATOR) is not None:

    class TestUnit(InstrumentConformance):
        """Pt100 with four wires over TCP; nobody at a port."""

        subject = InstrumentSubject(
            ScpiTemperature,
            "sim://cframe/unit?seed=3",
            settings={"timeout": 0.7},
            name="unit",
            dead_address="tcp://127.0.0.1:9",
        )
