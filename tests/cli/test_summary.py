"""The figures and notes of a result that are shown first."""

import math
from typing import Any

import numpy as np
import pytest
import xarray as xr

from errormotion import plugins
from errormotion.cli.summary import as_printed, figure_table, notes_of
from errormotion.datasets import build_errors, provenance
from errormotion.datasets.results.merit import figures_of
from errormotion.methods.beam_direction import BeamDirection, BeamDirectionSettings
from errormotion.plugins import FigureOfMerit


@pytest.fixture
def result() -> xr.Dataset:
    values = np.full((2, 6), np.nan)
    values[:, 0], values[0, 1] = [0.0, 2e-6], 0.0
    errors = build_errors(
        values,
        np.tile(1e-14 * np.eye(6), (2, 1, 1)),
        dims=("time",),
        coords={"time": [0.0, 90.0]},
        component="tool",
        machine="m",
        frame="machine",
        functional_point=np.zeros(3),
        reference="cold",
        method="unknown",
        method_version="1",
        provenance=provenance.make({}, None, None),
    )
    return errors.assign_attrs(notes=["one sensor is missing"])


def test_without_a_plugin_the_last_known_values_are_the_figures(result: xr.Dataset) -> None:
    first, second = (as_printed(figure) for figure in figures_of(result))
    assert first["name"] == "EX after 1.5 min"
    assert (first["value"], first["expanded_uncertainty"], first["unit"]) == pytest.approx((2.0, 0.2, "um"))
    assert second["name"] == "EY after 0.0 min"


def test_the_plugin_of_the_method_states_its_figures(result: xr.Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    class Foreign:
        @staticmethod
        def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
            return [FigureOfMerit("G(CW)", 5e-6, 1e-6, "m", limit=8e-6)]

    owners: dict[str, Any] = {"unknown": Foreign}
    monkeypatch.setattr(plugins, "owner_of_method", owners.get)
    shown = figure_table([as_printed(figure) for figure in figures_of(result)])
    assert shown.splitlines()[-1].split() == ["G(CW)", "5.0", "1.0", "um", "8"]


def test_values_have_the_digits_of_their_uncertainty() -> None:
    figures = [
        FigureOfMerit("radius", 0.0125004, 0.3e-6, "m"),
        FigureOfMerit("tilt", 1e-5, 2e-7, "rad"),
        FigureOfMerit("EX", 1e-6, math.nan, "m"),
    ]
    lines = figure_table([as_printed(figure) for figure in figures]).splitlines()
    assert [line.split()[1:] for line in lines[-3:]] == [
        ["12.50040", "0.00030", "mm"],
        ["2.063", "0.041", "arcsec"],
        ["1.00", "unknown", "um"],
    ]


def test_a_plan_has_notes_and_no_figures() -> None:
    planned = BeamDirection().plan(BeamDirectionSettings())
    assert figures_of(planned) == []
    assert notes_of(planned) == list(planned.attrs["notes"])
