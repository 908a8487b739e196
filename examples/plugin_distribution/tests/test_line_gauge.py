from line_gauge.driver import LineGauge

from errormotion.testing import InstrumentConformance, InstrumentSubject


class TestLineGauge(InstrumentConformance):
    subject = InstrumentSubject(LineGauge, "sim://cframe?seed=3")
