"""A tracker at four stations of the virtual machine: operator, simulators, recorder and identification."""

import re

import numpy as np
import pytest

from errormotion import datasets
from errormotion.campaign import runner
from errormotion.campaign.bench import OpenBench
from errormotion.campaign.files import load_campaign
from errormotion.errors import RunError
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.simulators import world
from errormotion.instruments.simulators.laser_tracker.leica_emscon import SimulatedEmScon
from errormotion.methods.multilateration import Multilateration, simulation
from errormotion.methods.multilateration.planning.layout import serpentine
from errormotion.twin import VirtualMachine

STATIONS = np.array([(-0.75, -0.6, -0.1), (0.8, -0.55, 0.0), (0.7, 0.65, -0.05), (-0.6, 0.5, 0.8)])
BENCH = """
schema = "errormotion.bench/1"
name = "Virtual volume"
machine = "C-frame (virtual)"

[instruments.tracker]
driver = "leica_emscon"
address = "sim://cframe/tracker?seed=3&lever=0.02,-0.01,-0.08&heading=0.4{fault}"

[instruments.control]
driver = "virtual_controller"
arm = true
address = "sim://cframe/controller?seed=3"
"""
CAMPAIGN = """
schema = "errormotion.campaign/1"
name = "Volume"
bench = "bench.toml"

[[test]]
name = "volume"
method = "multilateration"
[test.settings]
chain = "workpiece-X-Y-bed-Z-spindle-tool"
[test.settings.layout]
low = ["-200 mm", "-150 mm", "50 mm"]
high = ["200 mm", "150 mm", "400 mm"]
count = [3, 3, 3]
reflector = ["20 mm", "-10 mm", "-80 mm"]
stations = [
    ["-750 mm", "-600 mm", "-100 mm"],
    ["800 mm", "-550 mm", "0 mm"],
    ["700 mm", "650 mm", "-50 mm"],
    ["-600 mm", "500 mm", "800 mm"],
]
"""


class Operator:
    """Moves the tracker to the requested station, with a deviation of some millimetres."""

    def __init__(self):
        self.messages = []

    def __call__(self, message):
        self.messages.append(message)
        asked = np.array(re.search(r"near \((.*)\) mm", message)[1].split(","), float) * 1e-3
        (tracker,) = (each for each in world("cframe", seed=3)._devices if isinstance(each, SimulatedEmScon))
        tracker.carry_to(asked)


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """Return a function that writes bench and campaign; an operator moves the tracker."""
    monkeypatch.setattr(OpenBench, "virtual", property(lambda self: False))
    monkeypatch.delattr(VirtualController, "act")
    monkeypatch.setattr(VirtualController, "virtual", False)

    def write(fault="", **changes):
        text = CAMPAIGN
        for old, new in changes.items():
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "bench.toml").write_text(BENCH.format(fault=fault))
        (tmp_path / "campaign.toml").write_text(text)
        return load_campaign(tmp_path / "campaign.toml"), tmp_path / "runs"

    return write


def miss(run):
    """Return the deviations of the errors of the volume from the truth, in standard uncertainties, and the errors."""
    ds = datasets.load(run.errors)
    position = np.stack([ds[name].values for name in "xyz"], axis=-1)
    truth = simulation.true_errors(VirtualMachine("cframe", seed=3), position, (0.02, -0.01, -0.08))
    found = np.stack([ds[name].values for name in ("EX", "EY", "EZ")], axis=-1)
    true = np.stack([truth[name].values for name in ("EX", "EY", "EZ")], axis=-1)
    sigma = np.sqrt(np.diagonal(ds["covariance"].values, axis1=1, axis2=2))[:, :3]
    return (found - true) / sigma, true


def test_errors_of_the_volume_are_determined_within_their_uncertainty(lab):
    plan, runs = lab()
    operator = Operator()
    (run,) = runner.run(plan, runs=runs, ask=operator)
    raw = datasets.load(run.raw)
    datasets.validate(raw)
    assert raw.sizes["station"] == 4
    assert np.isfinite(raw["displacement"].values).all()
    assert float(raw["air_pressure"][0, 0]) == pytest.approx(100_800.0)
    assert len(operator.messages) == 4
    datasets.validate(datasets.load(run.errors))
    off, true = miss(run)
    # 93 numbers, most of them by few shared sources; by chance 4 sigma is passed once in 170 runs of so many.
    assert np.abs(off).max() < 4
    assert np.abs(true).max() > 3e-6


def test_an_interrupted_beam_loses_no_data(lab):
    plan, runs = lab("&fault=beam_broken&fault_at=20&fault_for=3")
    (run,) = runner.run(plan, runs=runs, ask=Operator())
    raw = datasets.load(run.raw)
    assert np.isfinite(raw["displacement"].values).all()
    times = raw["reading_time"].values[:, serpentine((3, 3, 3))]
    # In one set-up the targets read before the beam broke were visited again after the others.
    assert [bool(np.all(np.diff(row) > 0)) for row in times].count(False) == 1
    assert np.abs(miss(run)[0]).max() < 4


def test_a_tracker_at_an_unchanged_station_is_reported_and_not_measured(lab):
    plan, runs = lab()
    operator = Operator()

    def lazy(message):
        if not operator.messages:
            operator(message)

    with pytest.raises(RunError, match=r"Set-up S2: the tracker is near .* the position of S1"):
        runner.run(plan, runs=runs, ask=lazy)


def test_an_interrupted_campaign_continues_with_the_remaining_stations(lab, monkeypatch):
    plan, runs = lab()
    acquire = Multilateration.acquire

    def two(self, bench, settings, *, inputs, done=None):
        chunks = acquire(self, bench, settings, inputs=inputs, done=done)
        yield next(chunks)
        yield next(chunks)
        raise KeyboardInterrupt

    monkeypatch.setattr(Multilateration, "acquire", two)
    with pytest.raises(KeyboardInterrupt):
        runner.run(plan, runs=runs, ask=Operator())
    monkeypatch.setattr(Multilateration, "acquire", acquire)
    operator = Operator()
    (run,) = runner.resume(runs=runs, ask=operator)
    assert [message[8:10] for message in operator.messages] == ["S3", "S4"]
    assert [str(name) for name in datasets.load(run.raw)["station"].values] == ["S1", "S2", "S3", "S4"]
    assert np.abs(miss(run)[0]).max() < 4
