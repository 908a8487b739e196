"""Two methods on one virtual machine: contents of their results, agreement, and a detected error."""

from datetime import datetime

import numpy as np

from errormotion.compare import compare

DISPLACEMENTS = ["EX", "EY", "EZ"]
"""Probing sees the rotation of the frame of the axes, the bar the tilt of the spindle too."""


def test_the_results_state_the_data_of_a_comparison(results):
    drift, probing = results["drift"], results["probing"]
    raw_start = datetime.fromisoformat("2026-03-02T07:00:00+00:00")
    since = (datetime.fromisoformat(drift.attrs["start"]) - raw_start).total_seconds()
    np.testing.assert_allclose(since, drift.attrs["reference_time"], atol=1e-6)
    np.testing.assert_allclose(drift.attrs["reference_interval"], 0.0, atol=10.0)
    assert datetime.fromisoformat(probing.attrs["start"]) == raw_start
    first = probing["time"].values[0]
    np.testing.assert_array_equal(probing.attrs["reference_interval"], [first, first])
    for ds, name in ((drift, "reference "), (probing, "cold reference ")):
        reference = ds["source"].values[ds["source_reference"].values == 1]
        assert len(reference) > 0
        assert all(str(each).startswith(name) for each in reference)


def test_records_with_the_same_beams_share_their_calibration(warm_up):
    one, other, elsewhere = (warm_up(seed)["drift"] for seed in (3, 3, 4))
    ids = [{each for each in ds["source_id"].values.tolist() if each} for ds in (one, other, elsewhere)]
    assert ids[0] == ids[1]
    assert len(ids[0]) > 5
    assert not ids[0] & ids[2]


def test_two_methods_agree_at_their_common_point(results):
    found = compare(results, freedoms=DISPLACEMENTS)
    assert found["p"].item() > 0.05
    assert found.attrs["fit_p"] > 0.05


def test_a_wrong_functional_point_is_named_first(results):
    wrong = results["drift"].em.at((0.0, 0.0, -0.05)).assign_attrs(functional_point=np.zeros(3))
    found = compare({"drift": wrong, "probing": results["probing"]}, freedoms=DISPLACEMENTS).isel(pair=0, rank=0)
    assert found["cause"].item() == "functional point of 'drift'"
    z = found["size"].values[found["size_name"].values.tolist().index("Z (m)")]
    assert abs(z + 0.05) < 0.01
