"""The example of a crossbeam campaign, shortened, from the profiler's wire to errors with the truth in them."""

from pathlib import Path

import numpy as np
import pytest

from errormotion import datasets
from errormotion.campaign import runner
from errormotion.campaign.files import load_campaign
from errormotion.methods.crossbeam_scan import CrossbeamScan
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
from errormotion.twin import VirtualMachine

EXAMPLE = Path(__file__).parents[3] / "examples" / "virtual_gantry"
PLACES = [-0.2, 0.2]
#: two artefacts and one warm-up time instead of four each, half of a scan, and what says so in the files
SHORTER = {
    "bench.toml": [
        ("artefacts=-0.6,-0.2,0.2,0.6", "artefacts=-0.2,0.2"),
    ],
    "campaign.toml": [
        ('positions = ["-600 mm", "-200 mm", "200 mm", "600 mm"]', 'positions = ["-200 mm", "200 mm"]'),
        ('warm_up = ["7 min", "30 min", "60 min", "120 min"]', 'warm_up = ["60 min"]\nscan_length = "28 mm"'),
    ],
}


def test_the_example_can_be_read():
    plan = load_campaign(EXAMPLE / "campaign.toml")
    assert [(test.name, test.method) for test in plan.tests] == [("pose", CrossbeamScan), ("scan", CrossbeamScan)]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Return the run folders of the shortened example by the name of the test."""
    folder = tmp_path_factory.mktemp("gantry")
    for name, changes in SHORTER.items():
        text = (EXAMPLE / name).read_text()
        for old, new in changes:
            assert old in text, f"{name} has changed; shorten it anew"
            text = text.replace(old, new)
        (folder / name).write_text(text)
    plan = load_campaign(folder / "campaign.toml")
    done = runner.run(plan, runs=folder / "runs", ask=lambda message: pytest.fail(f"asked the operator: {message}"))
    return dict(zip(("pose", "scan"), done, strict=True))


def errors_of(run):
    (path,) = Path(run.path).rglob("errors.nc")
    return datasets.load(path)


def test_the_pose_is_that_of_the_virtual_machine(runs):
    ds = errors_of(runs["pose"])
    true = VirtualMachine("gantry", seed=3).crossbeam.pose
    u = np.sqrt(np.diag(ds["pose_covariance"].values))
    assert np.all(np.abs(ds["profiler_pose"].values[:3, 3] - true[:3, 3]) < 5 * u[3:] + 1e-9)


def test_truth_lies_within_five_standard_uncertainties(runs):
    ds = errors_of(runs["scan"])
    datasets.validate(ds)
    assert ds.sizes["time"] == 2
    assert not (ds["reason"] != "").any()
    assert ds["cold_repeat"].shape == (1, 2, 6)
    crossbeam = VirtualMachine("gantry", seed=3).crossbeam
    truth = crossbeam.twist(ds["scan_time"].values[1], np.array(PLACES))
    u = np.sqrt(np.diagonal(ds["covariance"].values[1], axis1=-2, axis2=-1))
    miss = ds.em.twist().values[1] - truth
    assert np.all(np.abs(miss) < 5 * u)
    assert np.abs(truth[:, :3]).max() > 5 * u[:, [0, 2]].max()  # and it is seen


def test_what_was_measured_can_be_identified_again(runs):
    ds = errors_of(runs["scan"])
    raw = datasets.load(Path(runs["scan"].path) / "raw.zarr")
    assert "record" in raw
    again = CrossbeamScan().identify(raw, CrossbeamScanSettings(strain="guided", guide_uncertainty=1e-6))
    np.testing.assert_array_equal(again.em.twist().values, ds.em.twist().values)
