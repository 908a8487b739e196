"""What every built-in method carries from the attributes of its raw data to its errors."""

import pytest

from errormotion import plugins

STATED = {
    "start": "2026-03-02T07:00:00+00:00",
    "chain": "workpiece-X-Y-bed-Z-spindle-tool",
    "operator": "M. Muster",
}


SLOW = ("crossbeam_scan-1",)
"""A campaign of scans."""


def subjects():
    found = [
        subject
        for name in (
            *("beam_direction", "crossbeam_scan", "linear_positioning", "multilateration"),
            *("normal_vector", "spindle_drift"),
        )
        for subject in plugins.get("methods", name)().conformance()
    ]
    names = [f"{each.plugin.info.id}-{k}" for k, each in enumerate(found)]
    return [
        pytest.param(each, id=name, marks=[pytest.mark.slow] * (name in SLOW))
        for each, name in zip(found, names, strict=True)
    ]


@pytest.mark.parametrize("subject", subjects())
def test_start_chain_and_operator_of_the_raw_data_are_attributes_of_the_errors(subject):
    raw, _ = subject.make(0)
    errors = subject.identify(raw.assign_attrs(STATED))
    assert errors.attrs["chain"] == STATED["chain"]
    assert errors.attrs["operator"] == STATED["operator"]
    if "cycle" not in raw.dims or "line_clock" in raw:  # scans have a clock of their own
        assert errors.attrs["start"].startswith("2026-03-02T07:00:")
