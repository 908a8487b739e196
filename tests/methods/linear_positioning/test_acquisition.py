"""Measuring with an interferometer and with a tracker in line, on a machine that does what real ones do."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from errormotion import datasets
from errormotion.errors import MethodError
from errormotion.methods.linear_positioning import LinearPositioning, Settings
from errormotion.methods.linear_positioning.acquisition.measure import measure_axis
from errormotion.methods.linear_positioning.settings import Budget
from errormotion.plugins.readings import Measurement

TEST = {"travel": (0.0, 0.4), "count": 5, "runs": 4, "average": 2, "dwell": 0.5, "settle": 0.2, "trials": 200}
EXACT = Budget(length=0.0, alignment=0.0)
PITCH = 20e-6  # rad/m
BACKLASH = 3e-6


def error(x):
    """Return the true positioning error at a position, m."""
    return 8e-6 * x + 2e-6 * np.sin(9.0 * x)


class Machine:
    """An axis with an error and a reversal error, and a clock of its own."""

    def __init__(self):
        self.place, self.actual, self.time, self.path = np.zeros(3), 0.0, 0.0, []

    def move_to(self, position, feed=None):
        x = position[0]
        lost = BACKLASH / 2.0 * np.sign(x - self.place[0])
        self.actual = x + error(x) + lost
        self.place = np.array(position, float)
        self.path.append(x)
        self.time += 1.0

    def elapse(self, seconds):
        self.time += seconds

    def state(self):
        return {"position": list(self.place), "time": self.time, "running": False}


class Interferometer:
    """Counts the displacement down, and the pitch; ``broken`` lists readings that break the beam."""

    info = SimpleNamespace(id="interferometer")
    channels = {"length": "m", "pitch": "rad"}  # noqa: RUF012

    def __init__(self, machine, broken=()):
        self.machine, self.broken, self.count, self.start, self.zeros = machine, set(broken), 0, None, 0

    def zero(self):
        self.start, self.zeros = self.machine.actual, self.zeros + 1

    def read(self):
        if self.count in self.broken:
            self.start = None
        self.count += 1
        if self.start is None:
            return {"length": np.nan, "pitch": np.nan}
        way = self.machine.actual - self.start
        return {"length": -way, "pitch": PITCH * way}


class Tracker:
    """A tracker on the far side of the axis, 5 mm off its line; ``renewed`` lists measurements with a new dead path."""

    info = SimpleNamespace(id="tracker")

    def __init__(self, machine, renewed=()):
        self.machine, self.renewed, self.count, self.path = machine, set(renewed), 0, 0

    def measure(self, target=None):
        self.path += self.count in self.renewed
        self.count += 1
        seen = np.array([2.0 - self.machine.actual, 0.005, 0.0])
        r = np.linalg.norm(seen)
        return Measurement(float(r), (float(np.arctan2(seen[1], seen[0])), np.pi / 2), valid=True, dead_path=self.path)


class Thermometer:
    channels = ("ball screw", "air")

    def read(self):
        return {"ball screw": 22.0, "air": 24.0}


class Bench:
    machine = "test"
    description = None

    def __init__(self, **kinds):
        self.kinds = kinds

    def of_kind(self, kind):
        return self.kinds[kind]

    def has_kind(self, kind):
        return kind in self.kinds


def measured(settings, done=None, **kinds):
    parts = list(measure_axis(Bench(**kinds), settings, done))
    dim = LinearPositioning().append_dim(settings)
    raw = xr.concat(parts, dim=dim, data_vars="minimal", coords="minimal", compat="override", combine_attrs="override")
    raw.attrs.pop("invalid")  # the runner adds the counts of the parts
    datasets.validate(raw)
    return raw


TWO = Settings(**TEST, freedoms=("EX", "EB"), channels={"EX": "-length", "EB": "pitch"})


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


def test_a_tracker_in_line_finds_the_same():
    machine = Machine()
    settings = Settings(**TEST, uncertainty=EXACT)
    raw = measured(settings, controller=machine, laser_tracker=Tracker(machine))
    errors = LinearPositioning().identify(raw, settings)
    P = errors["x"].values
    np.testing.assert_allclose(errors["EX"], error(P) - error(P[0]) - BACKLASH / 2, atol=1e-9)


def test_a_broken_beam_costs_the_rest_of_its_run():
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
    raw = measured(Settings(**TEST), controller=machine, laser_tracker=tracker)
    missing = np.isnan(raw["deviation"].values[0])
    assert missing[1].any()
    assert not missing[[0, 2, 3]].any()


def test_an_interrupted_run_goes_on_with_the_runs_that_are_missing():
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
    ("changes", "kinds", "text"),
    [
        ({}, ("interferometer",), "can move the axis"),
        ({}, ("controller",), "kind 'interferometer', or a 'laser_tracker'"),
        ({"channels": {"EX": "-length"}}, ("controller", "interferometer"), r"channels\.EB: expected a channel in rad"),
        (
            {"channels": {"EX": "pitch"}},
            ("controller", "interferometer"),
            r"length \(m\), pitch \(rad\); found 'pitch'",
        ),
        ({}, ("controller", "laser_tracker"), "reads EX alone; found EX, EB"),
        ({"limits": (0.0, 0.4)}, ("controller", "interferometer"), "limits: expected X"),
    ],
)
def test_what_cannot_be_measured_is_refused_before_anything_moves(changes, kinds, text):
    machine = Machine()
    every = {"controller": machine, "interferometer": Interferometer(machine), "laser_tracker": Tracker(machine)}
    with pytest.raises(MethodError, match=text):
        measured(TWO.model_copy(update=changes), **{name: every[name] for name in kinds})
    assert machine.path == []
