"""The instant of time 0 of a campaign: the start of the warm-up, from the two times of its lines."""

import numpy as np
import pytest
import xarray as xr

from errormotion.methods.crossbeam_scan.identification.scans import warm_up_start

RECORD = xr.Dataset(
    {
        "cycle_of_line": ("line", np.array([0, 0, 1, 1])),
        "line_time": ("line", np.array([-80.0, -79.0, 0.0, 1800.0])),
        "line_clock": ("line", np.array([10.0, 11.0, 95.5, 1895.5])),
    },
    attrs={"start": "2026-03-02T08:00:00+01:00"},
)
COLD = np.array([[-80.0], [1800.0]])


def test_start_of_the_warm_up_follows_from_both_times_of_a_warm_line():
    assert warm_up_start(RECORD, COLD, [0]) == "2026-03-02T07:01:35.500000+00:00"


def test_errors_relative_to_late_cold_scans_start_with_them():
    shifted = np.array([[4.5], [1800.0]])
    assert warm_up_start(RECORD, shifted, [0]) == "2026-03-02T07:01:40+00:00"


NAIVE = RECORD.assign_attrs(start="2026-03-02 08:00")


@pytest.mark.parametrize(
    "changed", [RECORD.drop_vars("line_clock"), RECORD.drop_attrs(), NAIVE, RECORD.isel(line=[0, 1])]
)
def test_nothing_is_stated_where_the_data_do_not_determine_it(changed):
    assert warm_up_start(changed, COLD, [0]) == ""
