"""Measurement with an interferometer and with a tracker in line, on a machine with backlash and pitch."""

import numpy as np
import pytest
import xarray as xr
from axis_doubles import BACKLASH, PITCH, Bench, Interferometer, Machine, Thermometer, Tracker, error
from coded import raises

from errormotion import datasets
from errormotion.methods.linear_positioning import LinearPositioning, LinearPositioningSettings
from errormotion.methods.linear_positioning.acquisition.measure import measure_axis
from errormotion.methods.linear_positioning.settings import Budget

TEST = {"travel": (0.0, 0.4), "count": 5, "runs": 4, "average": 2, "dwell": 0.5, "settle": 0.2, "trials": 200}
EXACT = Budget(length=0.0, alignment=0.0)


def measured(settings, done=None, **kinds):
    parts = list(measure_axis(Bench(**kinds), settings, done))
    dim = LinearPositioning().append_dim(settings)
    raw = xr.concat(parts, dim=dim, data_vars="minimal", coords="minimal", compat="override", combine_attrs="override")
    raw.attrs.pop("invalid")  # the runner adds the counts of the parts
    datasets.validate(raw)
    return raw


TWO = LinearPositioningSettings(**TEST, freedoms=("EX", "EB"), channels={"EX": "-length", "EB": "pitch"})


@pytest.mark.parametrize("cycle", ["linear", "pendulum"])
def test_an_interferometer_finds_the_errors_of_the_axis(cycle):
    machine = Machine()
    settings = TWO.model_copy(update={"cycle": cycle})
    raw = measured(settings, controller=machine, interferometer=Interferometer(machine))
    errors = LinearPositioning().identify(raw, settings.model_copy(update={"uncertainty": EXACT}))
    P = errors["x"].values
    # relative to the first target, approached forward
    np.testing.assert_allclose(errors["EX"], error(P) - error(P[0]) - BACKLASH / 2, atol=1e-12)
    np.testing.assert_allclose(errors["EB"], PITCH * (P - P[0]), atol=1e-9)
    assert float(errors["B_mean"]) == pytest.approx(BACKLASH, rel=1e-6)
    assert machine.path == [step.place[0] for step in LinearPositioning().motions(settings) if step.place]


def test_a_tracker_in_line_finds_the_errors_of_the_axis():
    machine = Machine()
    settings = LinearPositioningSettings(**TEST, uncertainty=EXACT)
    raw = measured(settings, controller=machine, laser_tracker=Tracker(machine))
    errors = LinearPositioning().identify(raw, settings)
    P = errors["x"].values
    np.testing.assert_allclose(errors["EX"], error(P) - error(P[0]) - BACKLASH / 2, atol=1e-9)


def test_readings_are_missing_from_a_broken_beam_to_the_end_of_its_run():
    machine = Machine()
    broken = Interferometer(machine, broken=[25])  # the third target of the second run, two readings at each of 10
    raw = measured(TWO, controller=machine, interferometer=broken)
    missing = np.isnan(raw["deviation"].sel(freedom="EXX").transpose("run", "approach", "target").values)
    assert not missing[[0, 2, 3]].any()
    assert not missing[1, 0, :2].any()
    assert missing[1, 0, 2:].all()
    assert missing[1, 1].all()
    assert broken.zeros == 2


def test_a_new_dead_path_of_a_tracker_is_a_broken_beam():
    machine = Machine()
    tracker = Tracker(machine, renewed=[30])
    raw = measured(LinearPositioningSettings(**TEST), controller=machine, laser_tracker=tracker)
    missing = np.isnan(raw["deviation"].values[0])
    assert missing[1].any()
    assert not missing[[0, 2, 3]].any()


def test_an_interrupted_test_continues_with_the_missing_runs():
    machine = Machine()
    whole = measured(TWO, controller=machine, interferometer=Interferometer(machine))
    again = Machine()
    rest = measured(TWO, done=whole.isel(run=slice(3)), controller=again, interferometer=Interferometer(again))
    assert rest.sizes["run"] == 1
    np.testing.assert_allclose(rest["deviation"], whole["deviation"].isel(run=[3]), atol=1e-12)


def test_temperatures_of_the_axis_are_recorded():
    machine = Machine()
    settings = TWO.model_copy(update={"machine": TWO.machine.model_copy(update={"sensors": ("ball screw",)})})
    raw = measured(settings, controller=machine, interferometer=Interferometer(machine), thermometer=Thermometer())
    assert (raw["temperature"].sel(sensor="ball screw") == 22.0).all()


@pytest.mark.parametrize(
    ("changes", "kinds", "code"),
    [
        ({}, ("interferometer",), "bench.controller.no_moves"),
        ({}, ("controller",), "position.instrument.missing"),
        ({"channels": {"EX": "-length"}}, ("controller", "interferometer"), "position.channel.unknown"),
        (
            {"channels": {"EX": "pitch"}},
            ("controller", "interferometer"),
            "position.channel.unknown",
        ),
        ({}, ("controller", "laser_tracker"), "position.freedoms.not_read"),
        ({"limits": (0.0, 0.4)}, ("controller", "interferometer"), "motion.limit.position"),
    ],
)
def test_an_impossible_test_is_refused_before_the_machine_moves(changes, kinds, code):
    machine = Machine()
    every = {"controller": machine, "interferometer": Interferometer(machine), "laser_tracker": Tracker(machine)}
    with raises(code):
        measured(TWO.model_copy(update=changes), **{name: every[name] for name in kinds})
    assert machine.path == []
