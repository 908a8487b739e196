"""A calibration belongs to one sensor."""

import json

import pytest

from errormotion.datasets.calibrations.owner import compare, known, serial_number
from errormotion.errors import DatasetError


def records(*serials: str, kind: str = "point_lds") -> str:
    return json.dumps([{"kind": kind, "identity": {"serial_number": serial}} for serial in serials])


@pytest.mark.parametrize(
    ("attrs", "expected"),
    [
        ({"serial_number": "A"}, "A"),
        ({"serial_number": "A", "instruments": records("B")}, "A"),
        ({"instruments": records("B")}, "B"),
        ({"instruments": records("B", "B")}, "B"),
        ({"instruments": records("B", "C")}, ""),
        ({"instruments": records("B", kind="thermometer")}, ""),
        ({"instruments": records("unknown")}, ""),
        ({"instruments": '[{"kind": "point_lds", "identity": null}]'}, ""),
        ({"provenance": f'{{"instruments": {records("D")}}}'}, "D"),
        ({"provenance": '{"instruments": [{"id": "twin", "simulated": true}]}'}, ""),
        ({}, ""),
    ],
)
def test_the_serial_number_of_a_dataset_is_stated_or_that_of_its_only_instrument(
    attrs: dict[str, str], expected: str
) -> None:
    assert serial_number(attrs, "point_lds") == expected


@pytest.mark.parametrize("text", ["", " ", "unknown", "Unknown", "not told over RS-232C"])
def test_a_text_for_a_missing_serial_number_is_not_one(text: str) -> None:
    assert known(text) == ""


def test_the_same_sensor_passes_without_a_note() -> None:
    assert compare("c", "A", "A", mid_ranges=(5e-3, 5e-3 + 1e-9)) == []


def test_all_differences_are_stated_at_once() -> None:
    with pytest.raises(DatasetError) as caught:
        compare("lk", "A", "B", mid_ranges=(0.0, 5e-3))
    assert str(caught.value) == (
        "Calibration 'lk': it belongs to the sensor with serial number A; the sensor in use has B; its mid-range is "
        "0 mm; that of the sensor in use (serial number B, calibrated: A) is 5 mm. Use the calibration of this sensor, "
        "or set allow_other_sensor = true."
    )
    first, second = compare("lk", "A", "B", mid_ranges=(0.0, 5e-3), allow_other_sensor=True)
    assert "serial number A; the sensor in use has B" in first
    assert "mid-range" in second
