from errormotion.instruments.point_lds.confocaldt import ConfocalDT
from errormotion.testing import InstrumentConformance, InstrumentSubject


class TestKit(InstrumentConformance):
    """A sensor of the frame, in the middle of the bar's range."""

    subject = InstrumentSubject(ConfocalDT, "sim://cframe/X1?seed=3", settings={"timeout": 2.0})
