from errormotion.instruments.point_lds.keyence_lk import KeyenceLK
from errormotion.testing import InstrumentConformance, InstrumentSubject

DIFFERENT = ",".join(f"{0.25 * number - 3.1:.2f}" for number in range(25))


class TestKit(InstrumentConformance):
    """Over a pty, with readings of both signs and all reasons of missing readings."""

    subject = InstrumentSubject(
        KeyenceLK,
        f"sim://cframe/lk?seed=3&wire=pty&readings=-9.9999,1,9.5,nan,-12,12,0,{DIFFERENT}",
        settings={"timeout": 0.5},
        name="pty",
        mutants=40,
    )
