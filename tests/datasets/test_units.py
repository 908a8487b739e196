import math

import numpy as np
import pytest
from pydantic import BaseModel, Field, ValidationError

from errormotion.datasets import units
from errormotion.datasets.units import EDGE, Angle, Frequency, Length, Speed, Temperature, Time, format_quantity
from errormotion.errors import DatasetError


class Settings(BaseModel):
    radius: Length = 0.005
    tilt: Angle = 0.0
    average: Time = Field(0.5, gt=0)
    spindle_speed: Speed = 0.0
    rate: Frequency = 20e3
    ambient: Temperature = 20.0


@pytest.mark.parametrize(
    ("quantity", "text", "value"),
    [
        (units.LENGTH, "10 mm", 0.01),
        (units.LENGTH, "25 um", 25e-6),
        (units.LENGTH, "25µm", 25e-6),
        (units.LENGTH, "-1.5e-3 m", -1.5e-3),
        (units.ANGLE, "3 arcsec", 1.454441043328608e-05),
        (units.ANGLE, "180 deg", math.pi),
        (units.TIME, "104 min", 6240.0),
        (units.SPEED, "15000 /min", 15000.0),
        (units.SPEED, "15000 rpm", 15000.0),
        (units.SPEED, "250 Hz", 15000.0),
        (units.FREQUENCY, "20 kHz", 20000.0),
        (units.TEMPERATURE, "-3.5 degC", -3.5),
        (units.TEMPERATURE, "293.15 K", 20.0),
        (units.VELOCITY, "1500 mm/min", 0.025),
        (units.EXPANSION, "2.1 um/K", 2.1e-6),
        (units.EXPANSION, "2.1 um/degC", 2.1e-6),
    ],
)
def test_text_with_a_unit_is_read_to_the_last_bit(quantity: units.Quantity, text: str, value: float) -> None:
    assert quantity.parse(text) == value


@pytest.mark.parametrize(
    "text", ["5", "mm", "", "5 s", "5 foo", "1,5 mm", "5 mm +", "5 %", "nan mm", "inf mm", "1e999 mm"]
)
def test_text_that_is_not_a_length_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ValueError, match="expected a length with its unit, such as '5 mm'"):
        units.LENGTH.parse(text)


def test_a_per_cent_is_not_an_angle_and_a_turn_not_a_frequency() -> None:
    with pytest.raises(ValueError, match="not convertible"):
        units.ANGLE.parse("5 %")
    with pytest.raises(ValueError, match="not convertible"):
        units.FREQUENCY.parse("15000 rpm")


def test_numbers_without_unit_are_si_in_python_and_refused_in_files() -> None:
    assert Settings(radius=0.004).radius == 0.004
    assert Settings.model_validate({"radius": "4 mm"}, context=EDGE).radius == 0.004
    with pytest.raises(ValidationError, match="expected a length with its unit, such as '5 mm'; found 5"):
        Settings.model_validate({"radius": 5}, context=EDGE)


@pytest.mark.parametrize("value", [math.nan, math.inf, True, None, [1.0]])
def test_a_value_that_is_not_a_finite_number_is_refused_in_python(value: object) -> None:
    with pytest.raises(ValidationError, match="expected a length"):
        Settings.model_validate({"radius": value})


def test_limits_of_a_field_are_in_si() -> None:
    with pytest.raises(ValidationError, match="greater than 0"):
        Settings.model_validate({"average": "-3 s"})


def test_settings_are_unchanged_after_a_round_trip() -> None:
    settings = Settings.model_validate({"radius": "4 mm", "tilt": "2 mrad"}, context=EDGE)
    assert Settings.model_validate(settings.model_dump(mode="json")) == settings


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (19.3e-6, "um", "19.3 um"),
        (-1e-9, "mm", "-0.000001 mm"),
        (15000.0, "/min", "15000 /min"),
        (20e3, "kHz", "20 kHz"),
        (math.pi / 648000 * 25, "arcsec", "25 arcsec"),
        (2.1e-6, "um/K", "2.1 um/K"),
        (0.0, "um", "0 um"),
        (-0.0, "um", "0 um"),
        (math.nan, "um", "unknown"),
    ],
)
def test_numbers_are_written_in_field_units(value: float, unit: str, text: str) -> None:
    assert format_quantity(value, unit) == text


def test_arrays_convert_elementwise() -> None:
    np.testing.assert_array_equal(units.convert(np.array([1.0, np.nan, 25.0]), "um", "m"), [1e-6, np.nan, 25e-6])


@pytest.mark.parametrize("unit", ["furlongish", "mm)", "kg"])
def test_a_unit_of_no_known_quantity_is_refused(unit: str) -> None:
    with pytest.raises(DatasetError, match=f"'{unit}'".replace(")", r"\)")):
        units.si_unit(unit)


@pytest.mark.parametrize(
    ("found", "usual"),
    [
        ("m2", "m^2"),
        ("m.s-1", "m/s"),
        ("m s-1", "m/s"),
        ("m/s2", "m/s^2"),
        ("W m-2 K-1", "W/m^2/K"),
        ("m²", "m^2"),
        ("µm·m⁻¹·K⁻¹", "um/m/K"),
        ("rad2", "rad^2"),
        ("um K-1", "um/K"),
        ("um/degC", "um/K"),
        ("degree_C", "degC"),
        ("degrees_Celsius", "degC"),
        ("arc_second", "arcsec"),
        ("µm", "um"),
        ("percent", "%"),
        ("1", "m/m"),
        ("s-1", "Hz"),
    ],
)
def test_units_as_cf_and_udunits_write_them_are_read(found: str, usual: str) -> None:
    assert units.convert(3.0, found, usual) == pytest.approx(3.0, rel=1e-15)
    assert units.convert(3.0, usual, found) == pytest.approx(3.0, rel=1e-15)


def test_text_with_a_unit_of_udunits_is_read() -> None:
    assert units.EXPANSION.parse("2.1 um K-1") == 2.1e-6
    assert units.VELOCITY.parse("1500 mm.min-1") == 0.025
    assert units.convert(50.0, "%", "1") == 0.5


@pytest.mark.parametrize(
    "unit",
    [
        *("5 mm-1", "mdegC", "nan", "NaN m", "inf", "m.", "1e-3 m", "m^99999999", "mm-1", "dBm", "pH", "Ym99"),
        *("m\0", "", "m--1", "seconds since 2020-01-01", "m" * 10_000, "m " * 10_000),
    ],
)
def test_an_invalid_unit_raises_an_error_of_the_package(unit: str) -> None:
    for target in ("m", "degC", "1", "W"):
        with pytest.raises(DatasetError, match=r"not (a known unit|convertible)"):
            units.convert(1.0, unit, target)


@pytest.mark.parametrize(
    "text", ["5 mm-1", "5 nan", "5 mdegC", "9" * 90 + "e99 Ym9", "9" * 10_000 + " mm", "5" + " " * 10_000]
)
def test_an_invalid_quantity_is_refused_with_an_example(text: str) -> None:
    for quantity in units.KINDS:
        with pytest.raises(ValueError, match=f"expected {quantity.kind} with its unit"):
            quantity.parse(text)


def test_the_table_of_usual_units_states_exactly_what_pint_does(monkeypatch: pytest.MonkeyPatch) -> None:
    pairs = [(a, b) for a, (one, _) in units._EXACT.items() for b, (other, _) in units._EXACT.items() if one == other]
    ours = [units._linear.__wrapped__(*pair) for pair in pairs]
    monkeypatch.setattr(units, "_EXACT", {})
    assert ours == [units._linear.__wrapped__(*pair) for pair in pairs]


def test_the_table_of_usual_units_refuses_another_kind_like_pint(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DatasetError) as ours:
        units._linear.__wrapped__("arcsec", "m")
    monkeypatch.setattr(units, "_EXACT", {})
    with pytest.raises(DatasetError) as others:
        units._linear.__wrapped__("arcsec", "m")
    assert str(ours.value) == str(others.value)
