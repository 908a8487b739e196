"""A wrong unit, and an instrument that hangs, leave a note that doubts the uncertainty, for every method."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr

from errormotion.datasets.clock import noted
from errormotion.datasets.plausibility import of_noise, of_raw, readings_of
from errormotion.datasets.raw import variant_of
from errormotion.datasets.schemas import raw_schemas
from errormotion.errors import MethodError
from errormotion.methods.linear_positioning import LinearPositioning
from errormotion.methods.linear_positioning.settings import Diagonals, LinearPositioningSettings
from errormotion.methods.r_test import RTest

AXIS = LinearPositioningSettings(freedoms=("EX",), runs=5, count=11, trials=200)
DIAGONALS = LinearPositioningSettings(diagonals=Diagonals(names=("PP0", "NP0", "PPP")), runs=5, count=7, trials=200)
CASES = [
    (LinearPositioning(), AXIS, "deviation"),
    (LinearPositioning(), DIAGONALS, "diagonal_deviation"),
    (RTest(), RTest().Settings(), "displacement"),
]


def changed(raw: xr.Dataset, name: str, change: Callable[[np.ndarray], np.ndarray]) -> xr.Dataset:
    old = raw[name]
    return raw.assign({name: (old.dims, change(old.values.copy()), {})})


def doubts_of(method: RTest | LinearPositioning, settings: LinearPositioningSettings, raw: xr.Dataset) -> list[str]:
    """Return the doubts, or the refusal, which is none of a unit where readings contradict one another."""
    try:
        return list(method.identify(raw, settings).em.doubts)
    except MethodError as error:
        return [str(error)]


@pytest.mark.parametrize(("method", "settings", "name"), CASES)
def test_readings_in_mm_without_a_unit_are_doubted_and_right_ones_are_not(method, settings, name) -> None:
    for seed in range(3):
        raw, _ = method.simulate(settings, seed)
        assert not any("unit" in note for note in doubts_of(method, settings, raw))
        doubts = doubts_of(method, settings, changed(raw, name, lambda y: 1e3 * y))
        assert any("probably in mm, and were taken as m" in note or "Check units" in note for note in doubts)
        doubts = doubts_of(method, settings, changed(raw, name, lambda y: 1e-3 * y))
        assert any("less than machine tools have" in note for note in doubts)


@pytest.mark.parametrize(("method", "settings", "name"), CASES)
def test_an_instrument_that_hangs_is_doubted_or_refused(method, settings, name) -> None:
    raw, _ = method.simulate(settings, 1)
    assert not any("equal" in note for note in doubts_of(method, settings, raw))
    last = {"sensor": 1, "sphere": 1} if name == "displacement" else {"run": 2, "approach": 1}
    held = raw.copy(deep=True)
    held[name][last] = float(raw[name][last].values.flat[0])
    found = doubts_of(method, settings, held)
    assert any(
        (f"{name}: " in note and "successive readings are equal" in note) or "contradict" in note for note in found
    )


def test_angles_name_their_unit_as_well() -> None:
    settings = LinearPositioningSettings(freedoms=("EA",), runs=5, count=11, trials=200)
    raw, _ = LinearPositioning().simulate(settings, 2)
    doubts = LinearPositioning().identify(changed(raw, "deviation", lambda y: 1e3 * y), settings).em.doubts
    assert any(note.startswith("The largest error, EA") and "in mrad" in note for note in doubts)
    assert "probably in mm" in of_noise(0.3e-3, "m", "the readings")
    assert of_noise(3e-6, "m", "the readings") == of_noise(5.0, "degC", "the readings") == ""


def test_every_raw_schema_with_readings_states_which_they_are() -> None:
    found = {table.title: readings_of(table) for table in raw_schemas()}
    assert sum(row is not None for row in found.values()) >= len(found) - 1  # but for logs of temperatures
    assert all(row is None or row.unit in ("m", "") for row in found.values())


def test_generic_code_notes_what_a_method_does_not() -> None:
    raw, _ = LinearPositioning().simulate(AXIS, 1)
    raw = changed(raw, "deviation", lambda y: np.zeros_like(y)).assign_attrs(schema=LinearPositioning.needs.raw_schema)
    table = variant_of(raw)
    assert table is not None
    (doubt,) = of_raw(raw, table)
    assert "all readings are equal" in doubt
    errors = xr.Dataset(attrs={"notes": ["one"]})
    twice = noted(noted(errors, raw), raw)
    assert twice.attrs["notes"] == ["one", doubt]
    assert twice.attrs["doubts_uncertainty"] == [doubt]


def test_nominal_data_of_all_methods_are_plausible() -> None:
    from errormotion.methods.circular_test.conformance import subjects as circular
    from errormotion.methods.normal_vector.conformance import subjects as balls
    from errormotion.methods.spindle_drift.conformance import subjects as drift

    for subject in (*circular(), *balls(), drift()[0]):
        errors, _ = subject.outcome(1)
        assert not errors.em.doubts
