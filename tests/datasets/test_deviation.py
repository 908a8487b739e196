"""Errors along one known direction, over dimensions that the method declares."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.spatial.transform import RigidTransform, Rotation

from errormotion import datasets
from errormotion.datasets import DOF, build_deviations
from errormotion.errors import DatasetError
from errormotion.kinematics import twists

ANGLE = np.linspace(0.0, 6.0, 5)
UNIT = np.stack([np.cos(ANGLE), np.sin(ANGLE), 0 * ANGLE], axis=-1)
TWIST = np.array([3e-6, -2e-6, 1e-6, 1e-5, -3e-5, 2e-5])


def radial(**changes: Any) -> xr.Dataset:
    """Return deviations of two directions of travel over the angle; the last value of the second is unknown."""
    h = np.hstack([UNIT, np.zeros((5, 3))])
    value = np.array([h @ TWIST, h @ TWIST + 1e-6])
    value[1, 4] = np.nan
    arguments: dict[str, Any] = {
        "deviation": value,
        "variance": np.full((2, 5), 5e-14),
        "sensitivity": h,
        "dims": ("travel", "angle"),
        "coords": {
            "travel": ("travel", ["CCW", "CW"], {"long_name": "direction of travel"}),
            "angle": ("angle", ANGLE, {"long_name": "on the circle", "units": "rad"}),
        },
        "influence": np.full((1, 2, 5), 2e-7),
        "sources": ["bar"],
        "source_groups": ["bar"],
        "component": "tool",
        "machine": "C-frame",
        "frame": "machine",
        "functional_point": (0.1, 0.2, 0.3),
        "reference": "nominal circle",
        "method": "bar",
        "method_version": "1",
        "provenance": {},
    }
    arguments |= changes
    if arguments["sensitivity"].ndim == 2 and "sensitivity" not in changes:
        arguments["sensitivity"] = np.broadcast_to(h, (2, 5, 6))
    return build_deviations(**arguments)


def test_no_freedom_is_known_from_a_deviation(tmp_path) -> None:
    ds = radial()
    assert datasets.violations(ds) == []
    assert all(np.isnan(ds[name]).all() for name in DOF)
    assert np.isnan(ds["covariance"]).all()
    assert np.isnan(ds["deviation_variance"].values[1, 4])
    assert np.isnan(ds["deviation_influence"].values[0, 1, 4])
    datasets.save(ds, tmp_path / "errors.nc")
    assert datasets.load(tmp_path / "errors.nc").identical(ds)


def test_a_constant_direction_has_no_dims() -> None:
    ds = radial(sensitivity=np.array([0.6, 0, 0.8, 0, 0, 0]))
    assert ds["sensitivity"].dims == ("dof",)
    assert datasets.violations(ds) == []


def test_the_accessor_treats_the_deviation_as_the_only_freedom() -> None:
    ds = radial()
    assert ds.em.names == ("deviation",)
    np.testing.assert_array_equal(ds.em.estimates().sel(dof="deviation").values, ds["deviation"].values)
    np.testing.assert_allclose(ds.em.expanded(k=2).values[0, :, 0], 2 * np.sqrt(5e-14))
    budget = ds.em.budget()
    assert list(budget["group"].values) == ["bar", "independent"]
    np.testing.assert_allclose((budget.values[:, 0] ** 2).sum(axis=0), 5e-14)
    np.testing.assert_allclose(ds.em.covariance_between((0, 0), (1, 2)).values, 4e-14)
    mean = ds.isel(travel=0).em.combine(np.full(5, 0.2), "angle")
    np.testing.assert_allclose(mean.value.values, [ds["deviation"].values[0].mean()])
    np.testing.assert_allclose(mean.covariance.values, [[4e-14 + 1e-14 / 5]])
    assert ds.em.iso_names() == {"deviation": "deviation"}
    figure = ds.isel(travel=0).em.plot()
    assert [axes.get_ylabel() for axes in figure.axes] == ["um"]
    assert figure.axes[0].get_xlabel() == "angle / deg"


def test_the_sensitivity_is_transformed_so_that_the_deviation_is_unchanged() -> None:
    """h . E is the same number at another functional point and in another frame."""
    ds, point = radial(), np.array([0.3, -0.1, 0.5])
    pose = RigidTransform.from_components([0.1, 0, 0.2], Rotation.from_rotvec([0.3, -0.2, 0.5]))
    moved = ds.em.at(point)
    A = twists.adjoint(shift=point - np.array(ds.attrs["functional_point"]))
    np.testing.assert_allclose(moved["sensitivity"].values @ (A @ TWIST), ds["sensitivity"].values @ TWIST, atol=1e-18)
    turned = ds.em.in_frame(pose, "table")
    Q = twists.adjoint(rotation=pose.rotation)
    np.testing.assert_allclose(turned["sensitivity"].values @ (Q @ TWIST), ds["sensitivity"].values @ TWIST, atol=1e-18)
    for other in (moved, turned):
        np.testing.assert_array_equal(other["deviation"].values, ds["deviation"].values)
        assert datasets.violations(other) == []


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"variance": np.full((2, 5), -1e-14)}, "deviation_variance = -1e-14 m"),
        ({"variance": np.full((2, 5), 1e-14)}, "squares that sum to no more than deviation_variance"),
        ({"sensitivity": 2 * np.ones(6)}, "unit vector for EX EY EZ; found one of length 3.4"),
        ({"deviation": np.full((2, 5), 3.0)}, "deviation = 3 m"),
        ({"sensitivity": np.zeros((2, 5))}, "do not fit together"),
        ({"coords": {"travel": ["CCW", "CW"], "angle": ANGLE}}, "declared by a coordinate .* found travel"),
        (
            {"coords": {n: (n, v, {"long_name": n}) for n, v in (("travel", ["A", "A"]), ("angle", ANGLE[::-1]))}},
            "travel: expected labels that differ(?s:.*)angle: expected the attribute units(?s:.*)values that increase",
        ),
        ({"component": "chain"}, "component_description"),
    ],
)
def test_a_violation_of_the_schema_is_refused(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(DatasetError, match=text):
        radial(**changes)


def test_a_declared_component_is_described() -> None:
    ds = radial(component="spindle and table", component_description="the spindle of the table drive")
    assert datasets.violations(ds) == []


def test_a_known_freedom_in_a_dataset_with_deviation_is_refused() -> None:
    ds = radial()
    ds["EX"][:] = 1e-6
    ds["covariance"].values[..., 0, 0] = 1e-14
    assert "EX: expected NaN in a dataset with deviation, their combination" in datasets.violations(ds)


@pytest.mark.parametrize("name", ["sensitivity", "deviation_variance", "deviation"])
def test_a_deviation_is_complete(name: str) -> None:
    assert any(name in text and "missing" in text for text in datasets.violations(radial().drop_vars(name)))


def test_gaps_are_the_same_in_value_and_variance() -> None:
    ds = radial()
    ds["deviation_variance"][0, 0] = np.nan
    assert "deviation_variance: expected NaN exactly where deviation is NaN" in datasets.violations(ds)
