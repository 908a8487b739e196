"""The figures that a person sees first of beams and volumes."""

import re

import numpy as np
import pytest
import xarray as xr

from errormotion.cli.summary import notes_of
from errormotion.methods.beam_direction import BeamDirection, Settings, simulation
from errormotion.twin import VirtualMachine


@pytest.fixture(scope="module")
def beam() -> xr.Dataset:
    planes = [(np.radians(20.0), np.radians(b)) for b in (0, 90, 180, 270)]
    raw = simulation.raw(VirtualMachine("cframe", seed=3), planes, seed=3, inclination_error=False)
    return BeamDirection().identify(raw)


def test_a_beam_is_told_with_its_expanded_uncertainty(beam: xr.Dataset) -> None:
    told = notes_of(beam)[0]
    assert told.startswith("beam against nominal (U: k = 2): EX ")
    found = re.findall(r"(E.) ([-+][0-9.]+) (um|arcsec) \(U = ([0-9.]+)\)", told)
    assert [name for name, *_ in found] == ["EX", "EY", "EZ", "EA", "EB", "EC"]
    for k, (name, value, unit, expanded) in enumerate(found):
        factor = 1e6 if unit == "um" else np.degrees(1) * 3600
        assert float(value) == pytest.approx(float(beam[name][0]) * factor, abs=0.006)
        u = np.sqrt(float(beam["covariance"][0, k, k]))
        assert float(expanded) == pytest.approx(2 * u * factor, abs=0.006)


def test_what_is_not_seen_has_no_figure(beam: xr.Dataset) -> None:
    unseen = beam.assign(EX=np.nan * beam["EX"], EY=np.nan * beam["EY"])
    assert "EX" not in notes_of(unseen)[0]
    assert "EZ" in notes_of(unseen)[0]


def test_a_plan_has_no_errors_to_tell() -> None:
    planned = BeamDirection().plan(Settings())
    assert notes_of(planned) == list(planned.attrs["notes"])


def test_a_volume_is_told_by_its_largest_and_its_usual_error() -> None:
    error = 1e-6 * np.array([[3.0, 4.0, 0.0], [0.0, 0.0, -1.0], [np.nan, 0.0, 0.0]])
    covariance = np.tile(np.diag([1e-12, 1e-12, 4e-12, 0, 0, 0]), (3, 1, 1))
    ds = xr.Dataset(
        {name: ("target", error[:, k]) for k, name in enumerate(("EX", "EY", "EZ"))}
        | {"covariance": (("target", "dof", "dof_"), covariance)},
        {"target": ["P1", "P2", "P3"]},
        {"component": "tool", "notes": ["one target is unknown"]},
    )
    figure, note = notes_of(ds)
    # sqrt((5^2 + 1^2) / 2) = 3.61; U of the rms: 2 (5 * 1 + 1 * 2) / 2 / 3.61
    assert figure == (
        "Volumetric error over 2 targets: largest 5.00 um at target P1 (U = 2.00 um, k = 2), root mean square 3.61 um "
        "(U at most 1.94 um)."
    )
    assert note == "one target is unknown"
