from errormotion.instruments.point_lds.capancdt import CapaNCDT
from errormotion.testing import InstrumentConformance, InstrumentSubject


class TestKit(InstrumentConformance):
    """A sensor of the frame, in the middle of the bar's range."""

    subject = InstrumentSubject(CapaNCDT, "sim://cframe/X1?seed=3", settings={"timeout": 2.0})
