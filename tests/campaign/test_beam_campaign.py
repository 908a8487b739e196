"""The example of a beam calibration with either sensor: the true beam is within its uncertainty."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from coded import raises

from errormotion import datasets
from errormotion.campaign import runner
from errormotion.campaign.files import load_campaign
from errormotion.errors import BenchError
from errormotion.methods.beam_direction import BeamDirection, simulation
from errormotion.twin import VirtualMachine

EXAMPLE = Path(__file__).parents[2] / "examples" / "virtual_beam"
KEYENCE = 'driver = "keyence_lk"\naddress = "sim://cframe/lk?seed=3"\nhead = "LK-H050"'
OPTO = 'driver = "optoncdt"\naddress = "sim://cframe/lds?seed=3&range=20"\nrange = "20 mm"'
ORIGIN = 'nominal_origin = ["50 mm", "0 mm", "-80 mm"]'
#: The readings of the optoNCDT begin at the start of its range, 10 mm nearer than the middle, and so does its beam.
FROM_START = 'nominal_origin = ["46.5798 mm", "0 mm", "-70.6031 mm"]'

COMPENSATION = 'compensation = "lk-h050"'
"""The calibration counts readings from the middle of the range."""


def never(message):
    pytest.fail(f"asked the operator: {message}")


def write(folder, bench=(), campaign=()):
    """Write the example with changes into a folder; calibrations stay where they are."""
    folder.mkdir(exist_ok=True)
    for name, changes in (("bench.toml", bench), ("campaign.toml", campaign)):
        text = (EXAMPLE / name).read_text()
        for old, new in changes:
            assert old in text, f"{name} has changed; change this test as well"
            text = text.replace(old, new)
        (folder / name).write_text(text)
    if not (folder / "calibrations").exists():
        (folder / "calibrations").symlink_to(EXAMPLE / "calibrations")
    return load_campaign(folder / "campaign.toml")


@pytest.fixture(scope="module", params=["keyence_lk", "optoncdt"])
def measured(request, tmp_path_factory):
    """Return the run of the campaign with a sensor, and the true beam of that sensor."""
    folder = tmp_path_factory.mktemp(request.param)
    machine = VirtualMachine("cframe", seed=3)
    if request.param == "keyence_lk":
        plan, truth = write(folder), simulation.truth_beam(machine)
    else:
        plan = write(
            folder,
            [(KEYENCE, OPTO)],
            [(ORIGIN, f"{FROM_START}\naverage = 1"), (COMPENSATION, f"{COMPENSATION}\nallow_other_sensor = true")],
        )
        truth = simulation.truth_beam(machine, machine.point_sensor.from_start(20e-3))
    (run,) = runner.run(plan, runs=folder / "runs", ask=never)
    return run, truth


def test_the_example_can_be_read_in_its_folder():
    plan = load_campaign(EXAMPLE / "campaign.toml")
    assert [(test.name, test.method) for test in plan.tests] == [("beam", BeamDirection)]


def test_truth_lies_within_the_stated_uncertainty(measured):
    run, truth = measured
    ds = datasets.load(run.errors)
    datasets.validate(ds)
    u = np.sqrt(np.diag(ds["covariance"].values[0]))
    for name in ("beam_origin", "beam_direction"):
        miss = (ds[name].values - truth[name].values)[0]
        spread = np.sqrt(np.diagonal(ds["beam_covariance"].values[0])).reshape(2, 3)[int(name == "beam_direction")]
        # Six numbers of one run: 3.5 sigma is passed by chance once in 350 runs, and the seed is fixed.
        assert np.all(np.abs(miss) < 3.5 * spread + 1e-7)
    assert u[3:].max() < np.radians(0.0670)  # the published mean error
    assert ds.sizes["plane"] == 3


def test_without_the_compensation_the_same_readings_deviate_from_the_truth(measured):
    run, truth = measured
    ds = datasets.load(run.errors)
    true = truth["beam_direction"].values[0]
    compensated = np.linalg.norm(ds["beam_direction"].values[0] - true)
    assert np.linalg.norm(ds["uncompensated_direction"].values[0] - true) > 10 * compensated


def test_raw_data_state_their_provenance(measured):
    run, _ = measured
    raw = datasets.load(run.raw)
    datasets.validate(raw)
    assert raw.attrs["sensor"] in ("keyence_lk", "optoncdt")
    assert raw.attrs["machine"] == "C-frame 610 x 510 x 460 mm (virtual)"
    np.testing.assert_allclose(raw["nominal_normal"].values[:, 2], np.cos(np.radians([25.0, 35.5, 35.5])), rtol=1e-12)
    low, high = raw["reading_range"].values
    readings = raw["distance"].values
    assert np.isfinite(readings).all()
    assert low < readings.min() < raw["mid_range"] < readings.max() < high


def test_a_calibration_that_is_deleted_after_reading_of_the_campaign_ends_the_test_before_it_measures(tmp_path):
    there = shutil.copytree(EXAMPLE / "calibrations", tmp_path / "lab" / "calibrations")
    gone = shutil.copy(there / "lk-h050.nc", there / "lk-h080.nc")
    plan = write(tmp_path / "lab", campaign=[('compensation = "lk-h050"', 'compensation = "lk-h080"')])
    gone.unlink()
    with raises("calibration.not_found"):
        runner.run(plan, runs=tmp_path / "runs", ask=never)
    (folder,) = (tmp_path / "runs").glob("*-beam-*")
    assert not (folder / "raw.zarr").exists()


def test_a_bench_without_a_control_is_refused_before_anything_is_measured(tmp_path):
    control = (
        '[instruments.control]\ndriver = "virtual_controller"\narm = true\naddress = "sim://cframe/controller?seed=3"'
    )
    with pytest.raises(BenchError, match=r"needs controller; the bench .* has point_lds"):
        write(tmp_path, [(control, "")])
