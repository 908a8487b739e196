from errormotion.instruments.line_profiler.keyence_ljx import KeyenceLJX
from errormotion.testing import InstrumentConformance, InstrumentSubject


class TestKit(InstrumentConformance):
    subject = InstrumentSubject(
        KeyenceLJX, "sim://cframe/profiler?seed=3&points=397&intensity=1", name="odd", mutants=40
    )
