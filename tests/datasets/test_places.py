"""Places are stated in field units: min, mm, degrees."""

import numpy as np
import pytest
import xarray as xr

from errormotion.datasets.results.places import in_field_units, place_of, scale_of


@pytest.fixture
def turned():
    """Return a dataset over 24 angles and three spheres."""
    angle = np.radians(15.0 * np.arange(24))
    return xr.Dataset(
        {"EX": (("angle", "sphere"), np.zeros((24, 3)))},
        {"angle": ("angle", angle, {"units": "rad"}), "sphere": ["front", "left", "right"]},
        {"component": "C"},
    )


def test_places_of_an_angle_are_in_degrees(turned):
    assert place_of(turned, ("angle", "sphere"), (1, 2)) == "angle 15 deg, sphere right"
    scale = scale_of(turned, "angle")
    assert scale.label == "angle / deg"
    np.testing.assert_allclose(scale.values, 15.0 * np.arange(24), atol=1e-12)


def test_a_single_place_is_not_named(turned):
    assert place_of(turned.isel(angle=[3]), ("angle", "sphere"), (0, 0)) == "sphere front"


@pytest.mark.parametrize(
    ("name", "values", "units", "unit", "last"),
    [
        ("time", [0.0, 3600.0], "s", "min", 60.0),
        ("time", [0.0, 90.0], "s", "s", 90.0),
        ("position", [0.0, 0.5], "m", "mm", 500.0),
        ("c", [0.0, np.pi], "", "deg", 180.0),
        ("load", [0.0, 12.0], "kg", "kg", 12.0),
    ],
)
def test_a_coordinate_has_its_field_unit(name, values, units, unit, last):
    attrs = {"units": units} if units else {}
    found, shown = in_field_units(xr.DataArray(values, dims=name, name=name, attrs=attrs))
    assert shown == unit
    assert found[-1] == pytest.approx(last)


def test_a_rotary_axis_is_the_scale_of_its_positions():
    ds = xr.Dataset(
        {"EX": ("position", np.zeros(4))},
        {"c": ("position", np.radians([0.0, 90.0, 180.0, 270.0]), {"units": "rad"})},
        {"component": "C"},
    )
    assert scale_of(ds, "position").label == "c position / deg"
    assert place_of(ds, ("position",), (3,)) == "c 270 deg"
