"""From scans to the errors of the axis: the truth of the virtual gantry lies within what is stated."""

import dataclasses
import logging

import needed_open3d
import numpy as np
import pytest
import xarray as xr
from scipy import stats
from scipy.spatial.transform import RigidTransform

from errormotion import compiling, datasets
from errormotion.datasets import provenance
from errormotion.methods.crossbeam_scan import CrossbeamScan, simulation
from errormotion.methods.crossbeam_scan.identification.chain import SOURCES
from errormotion.methods.crossbeam_scan.identification.profiler_pose import calibration
from errormotion.methods.crossbeam_scan.identification.registration import blocks, kernels
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
from errormotion.montecarlo.trials import sample, trial_model_of
from errormotion.twin import VirtualMachine
from errormotion.twin.sensors.profiler import Disturbances, Profiler

PROFILER = Profiler(800, 25e-6)
TIMES, PLACES = [0.0, 1800.0, 7200.0], [-0.5, 0.0, 0.5]
#: 1 mrad, 20 um and 1 mm, by which what the raw dataset states is off
POSE_COVARIANCE = np.diag([1e-3, 1e-3, 1e-3, 20e-6, 20e-6, 20e-6]) ** 2
LEVER_UNCERTAINTY = 1e-3
SEEDS = range(6)


@pytest.fixture(autouse=True)
def _quiet(caplog):
    caplog.set_level(logging.ERROR)


def campaign(machine, seed, *, times=TIMES, places=PLACES, **options):
    """Return scans of the twin, with pose and lever off by their uncertainty."""
    rng = np.random.default_rng([seed, 7])
    true = calibration.parameters(RigidTransform.from_matrix(machine.crossbeam.pose))
    pose = calibration.pose(*(true + rng.multivariate_normal(np.zeros(6), POSE_COVARIANCE))).as_matrix()
    given = {"profiles": 400, "feed": 70e-6, "profiler": PROFILER} | options
    raw = simulation.raw_scans(machine, times, places, seed=seed, pose=pose, **given)
    return raw.assign(
        lever=("direction", raw["lever"].values + rng.normal(0, LEVER_UNCERTAINTY, 3), {"units": "m"}),
        lever_uncertainty=("direction", np.full(3, LEVER_UNCERTAINTY), {"units": "m"}),
        pose_covariance=(("p", "p_"), POSE_COVARIANCE),
    )


EXACT = {"scale_uncertainty": 0.0, "expansion_uncertainty": 0.0, "mount_expansion_uncertainty": 0.0}
"""The twin's artefacts do not expand, and its profiler keeps its scale."""


def identify(raw, **settings):
    return CrossbeamScan().identify(raw, CrossbeamScanSettings(**EXACT, **settings))


@pytest.fixture(scope="module")
def machines():
    """A handful of gantries."""
    return [VirtualMachine("gantry", seed=seed) for seed in SEEDS]


@pytest.fixture(scope="module")
def campaigns(machines):
    """A campaign on each."""
    return [campaign(machine, seed) for machine, seed in zip(machines, SEEDS, strict=True)]


@pytest.fixture(scope="module")
def found(campaigns, remembering):
    """Errors of all campaigns, by way of treating the strain."""
    with remembering():
        return {strain: [identify(raw, strain=strain) for raw in campaigns] for strain in ("free", "guided", "rigid")}


@pytest.fixture(scope="module")
def with_repeat():
    """One campaign with a cold repeat, and its machine."""
    machine = VirtualMachine("gantry", seed=3)
    times = np.array([-120.0, -60.0, 1800.0])
    raw = campaign(machine, 3, times=times)
    return machine, raw.assign(warm_up=("cycle", np.maximum(times, 0.0)))


def misses(found, machines):
    """Return errors minus truth of the warm cycles, (campaign, cycle, position, 6)."""
    return np.array([miss(ds, machine) for ds, machine in zip(found, machines, strict=True)])


def miss(ds, machine):
    truth = simulation.truth_axis(machine, ds["time"].values, ds["y"].values).em.twist().values
    return ds.em.twist().values[1:] - truth[1:]


def stated(ds):
    """Return the standard uncertainty of the warm cycles, (cycle, position, 6)."""
    return np.sqrt(np.diagonal(ds["covariance"].values[1:], axis1=-2, axis2=-1))


def chi_squared(misses, covariances):
    """Return chi-squared of each twist, which has six degrees of freedom."""
    return np.array(
        [m @ np.linalg.solve(C * 1e12, m) * 1e12 for m, C in zip(misses.reshape(-1, 6), covariances, strict=True)]
    )


def nees(ds, machine):
    """Return the mean of chi-squared over six of one campaign."""
    return chi_squared(miss(ds, machine), ds["covariance"].values[1:].reshape(-1, 6, 6)).mean() / 6


# ---------------------------------------------------------------- truth


def test_truth_lies_within_the_stated_uncertainty(found, machines):
    """All values of a campaign at once, with what they share: pose, lever, cold scans."""
    total = 0.0
    for ds, machine in zip(found["free"], machines, strict=True):
        F = ds["influence"].transpose("source", "time", "position", "dof").values[:, 1:]
        n = F[0].size
        own = ds["covariance"].values[1:] - np.einsum("stki,stkj->tkij", F, F)
        C = F.reshape(-1, n).T @ F.reshape(-1, n)
        for k, block in enumerate(own.reshape(-1, 6, 6)):
            C[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += block
        e = miss(ds, machine).ravel()
        total += e @ np.linalg.solve(C * 1e12, e) * 1e12
    low, high = stats.chi2.interval(0.999, len(SEEDS) * n)
    assert low < total < high


@pytest.mark.parametrize("strain", ["free", "guided"])
def test_each_value_lies_within_what_is_stated(strain, found, machines):
    squares = [nees(ds, machine) for ds, machine in zip(found[strain], machines, strict=True)]
    # six campaigns of 36 numbers, many of which share a cold scan, a pose and a lever: 1 +- 0.12
    assert 0.7 < np.mean(squares) < 1.35
    u, e = np.array([stated(ds) for ds in found[strain]]), misses(found[strain], machines)
    assert np.mean(np.abs(e) < 2 * u) > 0.9
    assert np.all(np.abs(e) < 5 * u)


def test_a_guide_makes_pitch_certain(found):
    free, guided = (np.array([stated(ds) for ds in found[strain]]) for strain in ("free", "guided"))
    assert np.all(guided[..., 3] < 0.5 * free[..., 3])
    assert np.all(guided[..., 1] < 0.5 * free[..., 1])  # pitch acts over 2.2 m


@pytest.mark.parametrize("strain", ["free", "guided"])
def test_trials_have_the_stated_uncertainty(strain, campaigns, found, remembering):
    settings, errors = CrossbeamScanSettings(strain=strain, **EXACT), found[strain][0]
    with remembering():
        drawn = trial_model_of(CrossbeamScan(), campaigns[0], settings, errors)
    trials, reasons = sample(CrossbeamScan(), drawn, np.random.SeedSequence(1), range(60), (9, 6), list(drawn.sources))
    assert not reasons
    # 60 trials: 1 +- 0.09
    assert trials[:, 3:].std(axis=0) / stated(errors).reshape(6, 6) == pytest.approx(1, abs=0.4)


def test_rigid_registration_is_wrong_where_the_roll_changes(found, machines):
    # every campaign: the picture is turned in itself by what the roll changes along it
    assert all(nees(ds, machine) > 3 for ds, machine in zip(found["rigid"], machines, strict=True))


def test_rigid_registration_is_right_for_rigid_scans(machines):
    raw = campaign(machines[0], 0, times=[0.0, 7200.0], places=[0.0], motion="rigid")
    for strain in ("free", "rigid"):
        ds = identify(raw, strain=strain)
        assert np.all(np.abs(miss(ds, machines[0])) < 4 * stated(ds))


def test_rotation_of_the_carriage_alone_is_found_with_free_strain_only():
    machine = VirtualMachine("gantry", seed=3)
    # 40 urad of pitch that no guide explains
    machine.crossbeam = dataclasses.replace(machine.crossbeam, own=40e-6 * np.eye(6)[3])
    raw = campaign(machine, 3, times=[0.0, 7200.0])
    free, guided = (identify(raw, strain=strain) for strain in ("free", "guided"))
    assert np.all(np.abs(miss(free, machine)) < 4 * stated(free))
    assert np.all(np.abs(miss(guided, machine)[..., 3]) > 5 * stated(guided)[..., 3])
    loose = identify(raw, strain="guided", guide_uncertainty=50e-6)
    assert np.all(np.abs(miss(loose, machine)) < 4 * stated(loose))


def test_difference_of_two_times_has_the_covariance_of_its_independent_parts(found, machines):
    together, apart = [], []
    for ds, machine in zip(found["free"], machines, strict=True):
        rise = ds.em.combine([0, -1, 1], "time")
        e = miss(ds, machine)
        together.append(chi_squared(e[1] - e[0], rise.covariance.values))
        apart.append(chi_squared(e[1] - e[0], ds["covariance"].values[1] + ds["covariance"].values[2]))
    # 18 twists: 6 +- 0.8
    assert np.mean(together) == pytest.approx(6, abs=2.5)
    assert np.mean(apart) < 0.75 * np.mean(together)


def test_difference_of_two_positions_shares_pose_and_lever(found, machines):
    squares = []
    for ds, machine in zip(found["free"], machines, strict=True):
        step = ds.em.combine([-1, 0, 1], "position")
        e = miss(ds, machine)
        squares.append(chi_squared(e[:, 2] - e[:, 0], step.covariance.values[1:]))
    assert np.mean(squares) == pytest.approx(6, abs=2.5)


def test_budget_separates_pose_lever_and_cold_scans(found):
    budget = found["free"][0].em.budget()
    assert budget["group"].values.tolist() == ["profiler pose", "lever", "cold scan", "independent"]
    total = np.sqrt((budget.values[:, 1:] ** 2).sum(axis=0))
    assert total == pytest.approx(stated(found["free"][0]), rel=1e-6)
    # each cold scan is half of a pair, and counts for its own artefact alone
    cold, rest = budget.values[2, 1:], budget.values[3, 1:]
    assert cold / rest == pytest.approx(1, abs=0.5)
    F = found["free"][0]["influence"].transpose("source", "time", "position", "dof").values[len(SOURCES) :]
    assert not F[:6, :, 1:].any()
    assert F[:6, 1:, 0].any()


# ---------------------------------------------------------------- the dataset


def test_cold_row_is_zero_without_uncertainty(found):
    for runs in found.values():
        ds = runs[0]
        assert ds["time"].values.tolist() == TIMES
        for name in ("covariance", "influence"):
            assert not ds[name].transpose("time", ...).values[0].any()
        assert not ds.em.twist().values[0].any()
        assert set(ds["reason"].values[0]) == {""}


def test_dataset_has_its_attributes(found, machines, tmp_path):
    ds = found["free"][0]
    datasets.validate(ds)
    assert (ds.attrs["component"], ds.attrs["method"]) == ("Y", "crossbeam_scan")
    assert (ds.attrs["strain"], ds.attrs["registration"]) == ("free", "height_map")
    assert ds.attrs["machine"] == machines[0].name
    assert not np.any(ds.attrs["functional_point"])
    assert ds["y"].values.tolist() == PLACES
    assert ds.em.iso_names()["EX"] == "EXY"
    path = tmp_path / "errors.nc"
    datasets.save(ds, path)
    again = datasets.load(path)
    datasets.validate(again)
    xr.testing.assert_identical(again.drop_attrs(), ds.drop_attrs())
    assert list(again.attrs["notes"]) == list(ds.attrs["notes"])


def test_quality_is_that_of_the_sensor(found):
    ds, wrong = found["free"][0], Disturbances()
    # what scatters in a line; a mean over neighbours keeps some of the speckle out
    assert np.all((ds["noise_found"].values > wrong.noise) & (ds["noise_found"].values < 1e-6))
    jitter = ds["line_jitter"].transpose("time", "position", "jitter").values[1:]
    # of both scans together; along z and along y tell apart by the slopes alone
    assert jitter[..., 0] == pytest.approx(np.sqrt(2) * wrong.jitter_z, rel=0.4)
    assert jitter[..., 1] == pytest.approx(np.sqrt(2) * wrong.jitter_y, rel=0.4)
    assert np.all(ds["points_used"].values > 0.8 * 800 * 400)
    assert np.all(ds["predicted_u"].values[1:] < ds["registration_u"].values[1:])


def test_residual_of_the_registration_is_noise(found):
    ds = found["free"][0]
    before, after = ds["difference_before"].values[1:], ds["difference_after"].values[1:]
    assert np.nanstd(before) > 5e-6  # EZ of some micrometres, and slopes times EX and EY
    # in each place the mean of a block, whose line has jittered
    assert np.nanstd(after) < 2.5e-6
    assert ds["surface"].shape[0] == len(PLACES)
    assert np.nanmax(np.abs(ds["surface"].values)) < 6e-3


def test_strain_is_the_motion_of_the_axis_along_a_scan(found, machines):
    ds, crossbeam = found["free"][0], machines[0].crossbeam
    H, places = RigidTransform.from_matrix(crossbeam.pose), np.array(PLACES)
    slope = (crossbeam.twist(7200.0, places + 1e-3) - crossbeam.twist(7200.0, places - 1e-3)) / 2e-3
    known = H.rotation.inv().apply(slope[:, :3] + np.cross(slope[:, 3:], crossbeam.lever + H.translation))
    # a scale of the feed is determined by the curvature along it alone, ten times worse than the others
    assert ds["strain"].values[2][:, [0, 2]] == pytest.approx(known[:, [0, 2]], abs=10e-6)
    assert ds["strain"].values[2][:, 1] == pytest.approx(known[:, 1], abs=150e-6)
    assert not found["rigid"][0]["strain"].sel(direction="x").values[0].any()


def test_raw_dataset_is_not_modified_and_is_identified(campaigns, found):
    hashed = provenance.hash_dataset(campaigns[0])
    identify(campaigns[0])
    assert provenance.hash_dataset(campaigns[0]) == hashed
    assert hashed in str(found["free"][0].attrs["provenance"])


def test_unknown_uncertainties_are_reported(campaigns):
    bare = campaigns[0].drop_vars(["pose_covariance", "lever_uncertainty"]).isel(cycle=[0, 2])
    ds = identify(bare)
    assert any("pose of the profiler is assumed exact" in note for note in ds.attrs["notes"])
    assert any("lever is assumed exact" in note for note in ds.attrs["notes"])
    assert set(ds["source_group"].values) == {"cold scan"}  # pose and lever have no effect
    assert "pose_u" not in ds


def test_times_are_relative_to_the_start_of_the_warm_up(campaigns):
    late = campaigns[0].assign_coords(time=("cycle", [100.0, 1900.0, 7300.0], {"units": "s"}))
    assert identify(late)["time"].values.tolist() == TIMES


def test_cold_repeat_is_assessed_and_has_no_row(with_repeat):
    _, raw = with_repeat
    ds = identify(raw)
    assert ds["time"].values.tolist() == [0.0, 1800.0]
    assert ds["cold_repeat"].shape == (1, 3, 6)
    assert np.all(np.abs(ds["cold_repeat"].values) < 4 * ds["cold_repeat_u"].values)
    assert not any("cold scan and its repetition" in note for note in ds.attrs["notes"])


# ---------------------------------------------------------------- the same again


def assert_same(first, second):
    xr.testing.assert_identical(first.drop_attrs(), second.drop_attrs())


def test_repeated_identification_gives_the_same_bits(campaigns, found):
    assert_same(identify(campaigns[1]), found["free"][1])


def test_one_thread_and_two_give_the_same_bits(campaigns, monkeypatch):
    runs = []
    monkeypatch.setattr(blocks, "COMPILED_FROM", 0)
    monkeypatch.setattr(kernels, "MANY", 0)
    for threads in (1, 2):
        monkeypatch.setattr(compiling, "threads", lambda threads=threads: threads)
        runs.append(identify(campaigns[2]))
    assert_same(*runs)


def test_scans_on_disk_give_the_same_bits(campaigns, found, tmp_path):
    path = tmp_path / "raw.zarr"
    datasets.save(campaigns[0], path)
    again = identify(datasets.load(path))
    for name in ("EX", "EC", "covariance"):
        np.testing.assert_array_equal(again[name].values, found["free"][0][name].values)


def test_the_origin_of_the_carriage_is_stated_where_it_is_known(thin, thin_by_maps):
    assert "frame_origin" not in thin_by_maps.attrs
    placed = identify(thin[1], strain="rigid", carriage_origin=("0 mm", "-900 mm", "1200 mm"))
    assert placed.attrs["frame_origin"].tolist() == [0.0, -0.9, 1.2]
    assert datasets.violations(placed) == []


# ---------------------------------------------------------------- other registrations


@pytest.fixture(scope="module")
def thin():
    """A cold and a warm scan of a piece of one artefact that the axis carries as one, and their machine.

    The lines do not jitter: clouds know nothing of lines.
    """
    machine = VirtualMachine("gantry", seed=3)
    options = {"profiler": Profiler(400, 25e-6, disturbances=Disturbances.white()), "profiles": 200, "motion": "rigid"}
    return machine, campaign(machine, 3, times=[0.0, 7200.0], places=[0.2], **options)


@pytest.fixture(scope="module")
def thin_by_maps(thin):
    """Errors by height maps, each scan a rigid picture as the others take it."""
    return identify(thin[1], strain="rigid")


@pytest.fixture
def _open3d(thin_by_maps):
    # Maps first: numba warns where it starts its threads after Open3D has loaded a TBB of its own.
    needed_open3d.open3d()


@pytest.mark.usefixtures("_open3d")
@pytest.mark.parametrize("backend", ["open3d_plane", "paper"])
def test_other_registrations_state_a_larger_uncertainty(backend, thin, thin_by_maps):
    machine, raw = thin
    ds = identify(raw, strain="rigid", registration=backend)
    assert ds.attrs["registration"] == backend
    assert np.all(np.abs(miss(ds, machine)) < 4 * stated(ds))
    assert np.all(ds["registration_u"].values[1:] >= thin_by_maps["registration_u"].values[1:])


STRETCHED = 20e-6
"""Standard deviation of the scales of the profiler between cold and warm."""


def stretched(raw, rng):
    """Return scans whose warm pictures have scales along x and z of their own."""
    height, x = raw["height"].values.astype(float), raw["x"].values
    for scan in height[1:].reshape(-1, *height.shape[2:]):
        along, up = STRETCHED * rng.normal(size=2)
        scan += up * scan - along * x * np.gradient(scan, axis=1) / (x[1] - x[0])
    return raw.assign(height=(raw["height"].dims, height.astype(np.float32), raw["height"].attrs))


@pytest.mark.slow
def test_scales_of_the_profiler_are_in_the_uncertainty_without_being_stated():
    share, exact = [], []
    for seed in range(6):
        machine = VirtualMachine("gantry", seed=seed)
        options = {"profiler": Profiler(1600, 25e-6), "profiles": 800, "motion": "rigid"}
        scans = simulation.raw_scans(machine, [0.0, 3600.0], PLACES, seed=seed, **options)
        raw = stretched(scans, np.random.default_rng(seed))
        ds = CrossbeamScan().identify(raw, CrossbeamScanSettings(strain="rigid"))
        assert [note for note in ds.attrs["notes"] if "assumed to be 20 um/m" in note and "scale_uncertainty" in note]
        share.append(miss(ds, machine) / stated(ds))
        exact.append(miss(ds, machine) / stated(identify(raw, strain="rigid")))
    # Of 18 values of a freedom, 16 or more within the 95 % interval in 94 % of cases, 14 or more in 99.9 %.
    inside = (np.abs(np.concatenate(share, axis=1)) < 1.96).mean(axis=(0, 1))
    assert np.all(inside >= 14 / 18)
    assert (np.abs(np.concatenate(exact, axis=1)[..., 4]) < 1.96).mean() < 0.7


def test_exact_scales_are_not_noted(thin, thin_by_maps):
    assert "um/m" not in " ".join(thin_by_maps.attrs["notes"])
    stated = (
        CrossbeamScan().identify(thin[1], CrossbeamScanSettings(scale_uncertainty=1e-5, strain="rigid")).attrs["notes"]
    )
    assert [note for note in stated if note.endswith(": expansion_uncertainty, mount_expansion_uncertainty.")]
    assert [note for note in stated if "50 mm: the height of the artefacts (artefact_height)" in note]
