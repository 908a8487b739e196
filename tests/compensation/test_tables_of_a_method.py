"""A measurement of an axis by ISO 230-2, its compensation table, and the remaining true errors."""

import numpy as np
import table_readers

from errormotion.compensation.tables import axis_table, export, get
from errormotion.methods.linear_positioning import LinearPositioning, LinearPositioningSettings
from errormotion.methods.linear_positioning.simulation import Behaviour, raw_and_truth

REVERSAL = 8e-6


def test_both_directions_of_an_axis_that_was_measured_are_corrected() -> None:
    settings = LinearPositioningSettings(axis="Y", freedoms=("EY",), trials=200)
    within = []
    for seed in range(5):
        raw, truth = raw_and_truth(settings, seed, Behaviour(reversal=REVERSAL))
        errors = LinearPositioning().identify(raw, settings)
        table = axis_table(errors, "Y")
        exported = export(table, get("linuxcnc"))
        assert np.abs(table.backward - table.forward - REVERSAL).max() < 2e-6
        control = table_readers.linuxcnc({k: v for k, v in exported.files.items() if isinstance(v, str)})
        y = np.asarray(errors["y"].values)
        for direction in (1.0, -1.0):
            own = truth["EY"].values + direction * REVERSAL / 2  # the mean of both, and half of the reversal
            remaining = own + control(y, np.full(y.size, direction))
            within.append(np.abs(remaining) <= 2 * exported.uncertainty + exported.interpolation)
    assert np.mean(within) > 0.9
