"""Raw data of the method from plain arrays."""

import pytest
import xarray as xr

from errormotion.kinematics.iso import iso_names
from errormotion.methods.linear_positioning import LinearPositioning, LinearPositioningSettings

EXACT = {"uncertainty": {"length": 0.0, "alignment": 0.0}}
"""An instrument without uncertainty: nothing is corrected."""


@pytest.fixture
def raw_of():
    """Return a function that builds raw data from readings (freedom, run, approach, target) and positions."""

    def make(readings, position, axis="X", freedoms=("EX",), **variables):
        return xr.Dataset(
            {
                "deviation": (("freedom", "run", "approach", "target"), readings),
                "target_position": ("target", position, {"units": "m"}),
                **variables,
            },
            {"freedom": [iso_names(axis)[name] for name in freedoms], "approach": ["forward", "backward"]},
            {"schema": "errormotion.raw.linear_positioning/1", "axis": axis, "machine": "test"},
        )

    return make


@pytest.fixture
def identify():
    """Return a function that identifies raw data, by default of an instrument without uncertainty."""

    def run(raw, **settings):
        return LinearPositioning().identify(raw, LinearPositioningSettings(**{**EXACT, "trials": 200, **settings}))

    return run
