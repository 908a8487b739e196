"""Comparison, dashboard and Monte Carlo evaluation state places of an angle in degrees, as the report does."""

import numpy as np
import xarray as xr

from errormotion.compare.report.picture import abscissa
from errormotion.dashboard.curves import as_csv, curves_of
from errormotion.datasets import build_errors
from errormotion.montecarlo.result import LABELS, TABLE, lines

ANGLES = np.radians([0.0, 1.0, 90.0])
ANGLE = ("angle", ANGLES, {"units": "rad", "long_name": "angle of C"})


def errors():
    return build_errors(
        np.full((3, 6), 1e-6),
        np.broadcast_to(1e-14 * np.eye(6), (3, 6, 6)),
        dims=("angle",),
        coords={"angle": ANGLE},
        component="C",
        machine="table",
        frame="machine",
        functional_point=[0, 0, 0],
        reference="axis average line",
        method="other",
        method_version="1",
        provenance={"settings": {}},
    )


def test_the_dashboard_and_its_csv_are_in_degrees():
    found = curves_of(errors())
    assert found.label == "angle / deg"
    assert [line.partition(",")[0] for line in as_csv(found).splitlines()] == ["angle / deg", "0", "1", "90"]


def test_a_comparison_is_drawn_over_degrees():
    ds = xr.Dataset({"consensus": (("angle", "dof"), np.zeros((3, 6)))}, {"angle": ANGLE})
    places, label, joined = abscissa(ds)
    np.testing.assert_allclose(places, [0.0, 1.0, 90.0])
    assert (label, joined) == ("angle / deg", True)


def test_a_monte_carlo_evaluation_names_the_angle_in_degrees():
    sizes = {"angle": 3, "dof": 7, "limit": 2}
    variables = {
        name: (("angle", *dims[1:]), np.full((3, *(sizes[dim] for dim in dims[1:])), np.nan))
        for name, (dims, _) in TABLE.items()
    }
    for name in ("linear", "linear_uncertainty", "uncertainty", "tolerance", "verdict", "distance", "symmetric"):
        variables[name][1][:, 0] = 1.0
    variables["distance"][1][1, 0] = 2.0  # the largest difference is at 1 deg
    ds = xr.Dataset(
        variables, {"angle": ANGLE, **{dim: list(names) for dim, names in LABELS.items()}}, {"probability": 0.95}
    )
    assert [line.place for line in lines(ds)] == ["angle 1 deg"]
