"""The example, shortened, from the tracker's protocol to errors whose intervals contain the truth."""

from pathlib import Path

import numpy as np
import pytest

from errormotion import datasets
from errormotion.campaign import runner
from errormotion.campaign.files import load_campaign
from errormotion.methods.linear_positioning import LinearPositioning
from errormotion.twin import VirtualMachine

EXAMPLE = Path(__file__).parents[3] / "examples" / "virtual_positioning"


def test_the_example_can_be_read():
    plan = load_campaign(EXAMPLE / "campaign.toml")
    assert [(test.name, test.method) for test in plan.tests] == [("positioning-X", LinearPositioning)]


def test_a_tracker_in_line_measures_the_axis_of_the_virtual_machine(tmp_path):
    (tmp_path / "bench.toml").write_text((EXAMPLE / "bench.toml").read_text())
    text = (EXAMPLE / "campaign.toml").read_text()
    assert "average" not in text.replace("average = 5", "")
    (tmp_path / "campaign.toml").write_text(text.replace("average = 5", "average = 1\ncount = 5\nruns = 4"))
    plan = load_campaign(tmp_path / "campaign.toml")
    (done,) = runner.run(plan, runs=tmp_path / "runs", ask=lambda message: pytest.fail(f"asked: {message}"))
    (path,) = Path(done.path).rglob("errors.nc")
    errors = datasets.load(path)
    P = errors["x"].values
    machine = VirtualMachine("cframe", seed=3)
    true = machine.volumetric_truth(np.column_stack([P, 0.0 * P, 0.0 * P + 0.2]))["EX"].values
    # relative to the first target, with the repeatability of the zero itself, 0.3 um
    u = np.sqrt(errors["covariance"].values[:, 0, 0] + 0.3e-6**2)
    assert (np.abs(errors["EX"].values - (true - true[0])) < 4.0 * u).all()
    assert np.ptp(true) > 4.0 * u.max()


def test_an_interferometer_measures_the_diagonals_of_the_virtual_machine(tmp_path):
    folder = EXAMPLE.parent / "virtual_diagonals"
    (tmp_path / "bench.toml").write_text((folder / "bench.toml").read_text())
    text = (folder / "campaign.toml").read_text()
    (tmp_path / "campaign.toml").write_text(text.replace("average = 5", "average = 1\ncount = 4\nruns = 4"))
    plan = load_campaign(tmp_path / "campaign.toml")
    (done,) = runner.run(plan, runs=tmp_path / "runs", ask=lambda message: None)
    (path,) = Path(done.path).rglob("errors.nc")
    errors = datasets.load(path)
    machine = VirtualMachine("cframe", seed=3)
    points = errors["stop_point"].values
    unit = errors["sensitivity"].values[..., :3]
    true = (machine.volumetric_truth(points.reshape(-1, 3))[["EX", "EY", "EZ"]].to_array().values.T).reshape(
        points.shape
    )
    true = ((true - true[:, :1]) * unit).sum(axis=-1)
    # relative to the first stop, with the repeatability of the zero itself, 0.3 um
    u = np.sqrt(errors["deviation_variance"].values + 0.3e-6**2)
    assert (np.abs(errors["deviation"].values - true) < 4.0 * u).all()
    assert np.ptp(true) > 4.0 * u.max()
