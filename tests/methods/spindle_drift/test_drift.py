"""Spindle drift from raw dataset to error dataset, against the virtual machine's truth."""

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion.datasets import validate
from errormotion.errors import DatasetError, MethodError
from errormotion.estimation.low_rank import whitener
from errormotion.methods.spindle_drift import SpindleDrift, SpindleDriftSettings, simulation
from errormotion.twin import Event, VirtualMachine

SEEN = slice(0, 5)  # EC is not seen
TIMES = np.array([0.0, 600.0, 1800.0, 3600.0, 6000.0])


@pytest.fixture(scope="module")
def machine():
    machine = VirtualMachine("cframe", seed=3)
    machine.start([Event(0.0, 15000.0)])
    return machine


@pytest.fixture(scope="module")
def method():
    return SpindleDrift()


def detected(machine, method, seed):
    """Return beams as a detection finds them: origin, direction, covariance."""
    beams = method.identify(simulation.raw_beam_detection(machine, seed=seed))
    return beams["beam_origin"].values, beams["beam_direction"].values, beams["beam_covariance"].values


def truth_of(machine, errors):
    twist = np.asarray(
        machine.truth_spindle(TIMES[: errors.sizes["time"]], errors.attrs["functional_point"]).em.twist()
    )
    return (twist - twist[0])[:, SEEN]


@pytest.mark.slow
@pytest.mark.usefixtures("without_paper")
def test_stated_intervals_contain_the_truth_and_the_joint_covariance_is_right(machine, method):
    seeds, inside, joint, slopes = 60, [], [], []
    for seed in range(seeds):
        raw = simulation.raw_drift(machine, TIMES, seed=seed, beams=detected(machine, method, 1000 + seed))
        errors = method.identify(raw, SpindleDriftSettings(compensate_frame=False))
        truth = truth_of(machine, errors)
        miss = np.asarray(errors.em.twist())[:, SEEN] - truth
        covariance = errors["covariance"].values[:, SEEN, SEEN]
        inside.append(np.abs(miss[1:]) <= 1.96 * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))[1:])
        joint += [miss[t] @ np.linalg.solve(covariance[t], miss[t]) for t in range(1, 5)]
        # The change between two late instants: the reference state drops out, which only the influences know.
        change = errors.em.combine([0.0, 0.0, 0.0, -1.0, 1.0], dim="time")
        value, spread = np.asarray(change[0])[SEEN], np.asarray(change[1])[SEEN, SEEN]
        off = value - (truth[4] - truth[3])
        slopes.append(off @ np.linalg.solve(spread, off))
    # 60 seeds of 4 instants that share their reference: the share of 60 draws, within 99.9 %.
    fraction = np.mean(inside, axis=(0, 1))
    assert (fraction > 0.95 - 3.3 * np.sqrt(0.05 * 0.95 / seeds)).all(), fraction
    # Chi-square of 5 freedoms: mean 5, spread sqrt(10 / 60) of the mean over seeds.
    assert abs(np.mean(joint) - 5) < 3.3 * np.sqrt(10 / seeds)
    assert abs(np.mean(slopes) - 5) < 3.3 * np.sqrt(10 / seeds)


def test_noise_free_readings_give_the_truth_to_a_tenth_of_a_nanometre(machine, method):
    raw = simulation.raw_drift(machine, TIMES, seed=0, radius_error=False)
    raw["distance"] = (("channel", "time"), machine.still_readings(TIMES, expansion=False, warm_up=False))
    errors = method.identify(raw, SpindleDriftSettings(compensate_frame=False))
    miss = np.asarray(errors.em.twist())[:, SEEN] - truth_of(machine, errors)
    assert np.abs(miss[:, :3]).max() < 1e-10  # the unseen EC acts over the 12 um to the functional point
    assert np.abs(miss[:, 3:]).max() < 1e-9


def test_nominal_beams_state_a_larger_uncertainty(machine, method):
    raw = simulation.raw_drift(machine, TIMES, seed=1, beams=detected(machine, method, 1))
    frame = machine.frame
    raw["nominal_origin"] = (("channel", "direction"), frame.nominal_origin)
    raw["nominal_direction"] = (("channel", "direction"), frame.nominal_direction)
    found = {
        beams: method.identify(raw, SpindleDriftSettings(beams=beams, compensate_frame=False))
        for beams in ("raw", "nominal")
    }
    miss = {b: np.abs(np.asarray(e.em.twist())[:, SEEN] - truth_of(machine, e)) for b, e in found.items()}
    sigma = {b: np.sqrt(np.diagonal(e["covariance"].values, axis1=1, axis2=2))[:, SEEN] for b, e in found.items()}
    assert miss["nominal"][-1, :2].max() > 3 * miss["raw"][-1, :2].max()
    assert sigma["nominal"][-1, :2].min() > 3 * sigma["raw"][-1, :2].max()
    assert (miss["nominal"][1:] < 4 * sigma["nominal"][1:]).all()


def test_ec_is_unknown_and_never_zero(machine, method):
    errors = method.identify(simulation.raw_drift(machine, TIMES, seed=0))
    assert np.isnan(errors["EC"]).all()
    assert np.isnan(errors["covariance"].sel(dof="EC")).all()
    validate(errors)


def test_the_functional_point_may_be_chosen_and_only_moves_the_errors(machine, method):
    raw = simulation.raw_drift(machine, TIMES, seed=0)
    at_end = method.identify(raw)
    higher = method.identify(raw, SpindleDriftSettings(functional_point=(0.0, 0.0, 0.08)))
    moved = at_end.em.at([0.0, 0.0, 0.08])
    for name in ("EX", "EY", "EZ", "EA", "EB"):
        np.testing.assert_allclose(higher[name], moved[name], rtol=0, atol=1e-10)


def test_record_is_not_modified(machine, method):
    raw = simulation.raw_drift(machine, TIMES, seed=0)
    copy = raw.copy(deep=True)
    method.identify(raw)
    xr.testing.assert_identical(raw, copy)


def test_order_of_channels_and_dims_and_float32_do_not_matter(machine, method):
    raw = simulation.raw_drift(machine, TIMES, seed=0)
    other = raw.isel(channel=[4, 2, 0, 3, 1]).transpose("time", ...)
    a, b = method.identify(raw), method.identify(other)
    np.testing.assert_allclose(a["EZ"], b["EZ"], rtol=0, atol=1e-15)
    np.testing.assert_allclose(a["EA"], b["EA"], rtol=0, atol=1e-13)
    c = method.identify(raw.assign(distance=raw["distance"].astype(np.float32)))
    # float32 resolves a millimetre to 0.12 nm.
    np.testing.assert_allclose(a["EX"], c["EX"], rtol=0, atol=1e-9)


def test_means_of_a_fast_record_are_those_of_the_slow_one(machine, method):
    """2 s at 2 kHz, averaged here, against the same readings averaged beforehand."""
    raw = simulation.raw_drift(machine, np.arange(0, 2, 1 / 2000), seed=5, averaged=1)
    raw = raw.drop_vars(["temperature", "spindle_speed", "sensor"])
    slow = raw.isel(time=slice(0, None, 1000)).copy(deep=True)
    slow["distance"] = (("channel", "time"), raw["distance"].values.reshape(5, 4, 1000).mean(axis=2))
    slow["distance_noise"] = raw["distance_noise"] / np.sqrt(1000)
    a, b = method.identify(raw), method.identify(slow)
    np.testing.assert_allclose(a["EZ"], b["EZ"], rtol=0, atol=1e-15)
    np.testing.assert_allclose(a["covariance"], b["covariance"], rtol=1e-6, atol=1e-22)


def test_more_noise_than_stated_is_reported_and_increases_the_uncertainty(machine, method):
    t = np.arange(0, 200, 0.5)
    raw = simulation.raw_drift(machine, t, seed=6)
    noisy = raw.copy(deep=True)
    noisy["distance_noise"] = raw["distance_noise"] / 3
    auto, stated = method.identify(noisy), method.identify(noisy, SpindleDriftSettings(noise="stated"))
    honest = method.identify(raw)
    sigma = [np.sqrt(e["covariance"].sel(dof="EX", dof_="EX").values[-1]) for e in (auto, stated, honest)]
    assert sigma[0] == pytest.approx(sigma[2], rel=0.15)  # 400 differences: 6 %, and two channels
    assert sigma[1] == pytest.approx(sigma[2] / 3, rel=0.01)
    assert any("the stated noise is 0.001 um" in note for note in auto.attrs["notes"])
    assert not any("stated noise" in note for note in honest.attrs["notes"])


def test_less_noise_than_stated_is_reported(machine, method):
    raw = simulation.raw_drift(machine, np.arange(0, 200, 0.5), seed=6)
    plain = method.identify(raw)
    raw["distance_noise"] = 3 * raw["distance_noise"]
    notes = [note for note in method.identify(raw).attrs["notes"] if "follows from the stated noise" in note]
    assert [note[:2] for note in notes] == ["X1", "X2", "Y1", "Y2", "Z:"]
    assert not any("stated noise" in note for note in plain.attrs["notes"])


def test_an_uncertainty_of_the_radius_that_is_not_stated_is_noted(machine, method):
    raw = simulation.raw_drift(machine, TIMES, seed=0)
    assumed, stated = method.identify(raw), method.identify(raw, SpindleDriftSettings(bar_radius_uncertainty="1 um"))
    note = "Assumed: no uncertainty of the radius of the bar (bar_radius_uncertainty = 0)."
    assert note in assumed.attrs["notes"]
    assert not any("radius of the bar" in each for each in stated.attrs["notes"])
    xr.testing.assert_equal(assumed["EX"], stated["EX"])


def test_a_sensor_out_of_range_for_ten_minutes_loses_only_these(machine, method):
    t = np.arange(0, 3600.0, 10.0)
    raw = simulation.raw_drift(machine, t, seed=7)
    gap = (t >= 1200) & (t < 1800)
    cut = raw.copy(deep=True)
    cut["distance"][1, gap] = np.nan
    whole, errors = method.identify(raw), method.identify(cut)
    assert np.isnan(errors["EX"].values[gap]).all()
    np.testing.assert_allclose(errors["EX"].values[~gap], whole["EX"].values[~gap], rtol=0, atol=1e-15)
    assert any(note.startswith("X2: 60 of 360 means are unknown") for note in errors.attrs["notes"])
    assert float(errors["valid_fraction"].sel(channel="X2").mean()) == pytest.approx(5 / 6)


def test_expansion_of_the_frame_is_corrected_by_its_temperature(machine, method):
    t = np.arange(0, 6000.0, 10.0)
    raw = simulation.raw_drift(machine, t, seed=8, expansion=True)
    raw["frame_expansion"] = (("channel", "direction"), machine.frame.expansion)
    truth = np.asarray(machine.truth_spindle(t, [0, 0, 0]).em.twist())
    truth = truth - truth[0]
    with_it, without = method.identify(raw), method.identify(raw, SpindleDriftSettings(compensate_frame=False))
    miss = [np.abs(np.asarray(e.em.twist()) - truth)[-1, :3] for e in (with_it, without)]
    sigma = np.sqrt(np.diagonal(with_it["covariance"].values[-1]))[:3]
    assert (miss[1] > 0.5e-6).all()  # 1.3 to 2.4 um/K over about a kelvin
    assert (miss[0] < 3 * sigma).all()
    assert (miss[0] < 0.3 * miss[1]).all()
    assert (sigma > 0.05 * miss[1]).all()  # a tenth of what was taken out is in the budget


def test_record_that_starts_with_the_spindle_has_its_reference_after_spin_up(machine, method):
    machine = VirtualMachine("cframe", seed=4)
    machine.start([Event(0.0, 15000.0)])
    rate = 2500.0
    raw = simulation.raw_drift(machine, np.arange(0, 4, 1 / rate), seed=0, averaged=1)
    raw["distance"] = (("channel", "time"), machine.distances(0, raw.sizes["time"], rate))
    raw["spindle_speed"] = ("time", np.full(raw.sizes["time"], 15000.0))
    errors = method.identify(raw)
    assert np.isnan(errors["EX"].values[:2]).all()
    assert errors["time"].values[2] == pytest.approx(0.0)
    assert abs(errors["EX"].values[2]) < 1e-15
    run_out = method.identify(raw, SpindleDriftSettings(reference_time=0.0))
    noise = 0.3e-6 / np.sqrt(rate / 2) * np.sqrt(2)
    assert np.abs(errors["EX"].values[3:]).max() < 4 * noise
    # With the first half second as reference, its run-out is in every later value.
    assert np.abs(run_out["EX"].values[3:]).min() > 4 * noise


# ------------------------------------------------------------------ wrong inputs


def spoilt(machine, name):
    raw = simulation.raw_drift(machine, TIMES, seed=0)
    if name == "missing channel":
        return raw.isel(channel=[0, 1, 2, 4])
    if name == "bar radius in mm":
        return raw.assign(bar_radius=5.0)
    if name == "parallel beams":
        raw["beam_direction"][2:4] = raw["beam_direction"][:2].values
    if name == "unknown beam":
        raw["beam_origin"][3] = np.nan
    if name == "dead sensor":
        raw["distance"][4] = np.nan
    if name == "no reference":
        raw["distance"][1, 0] = np.nan
    if name == "wrong bar":
        raw = raw.assign(bar_radius=raw["bar_radius"] * 4)
        raw["beam_origin"] = raw["beam_origin"] + 0.05
    if name == "foreign schema":
        raw.attrs["schema"] = "errormotion.raw.crossbeam_scan/1"
    return raw


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("missing channel", DatasetError, "Y2"),
        ("bar radius in mm", DatasetError, "bar_radius.*mm"),
        ("parallel beams", MethodError, "X1 and Y1 are parallel"),
        ("unknown beam", (MethodError, DatasetError), "Y2|beam_origin"),
        ("dead sensor", MethodError, "Channel Z has no valid reading"),
        ("no reference", MethodError, "no valid reading of X2"),
        ("foreign schema", (MethodError, DatasetError), "crossbeam_scan|height"),
    ],
)
def test_wrong_inputs_are_refused_with_a_helpful_message(machine, method, name, error, message):
    with pytest.raises(error, match=f"(?s){message}"):
        method.identify(spoilt(machine, name))


def test_missing_nominal_beams_are_reported(machine, method):
    with pytest.raises(MethodError, match="nominal_origin"):
        method.identify(spoilt(machine, ""), SpindleDriftSettings(beams="nominal"))


def test_plan_predicts_the_uncertainty_on_the_virtual_machine(machine, method):
    plan = method.plan()
    validate(plan)
    predicted = np.sqrt(np.diagonal(plan["covariance"].values[-1]))[SEEN]
    raw = simulation.raw_drift(machine, TIMES, seed=0, beams=detected(machine, method, 0))
    stated = np.sqrt(np.diagonal(method.identify(raw)["covariance"].values[-1]))[SEEN]
    # The twin's frame is misaligned and its drift another one than the plan's: the same within a tenth.
    np.testing.assert_allclose(predicted, stated, rtol=0.1)


# ------------------------------------------------------------------ while measuring


def test_the_live_view_ends_where_the_identification_does(machine, method):
    t = np.arange(0, 600.0, 0.5)
    raw = simulation.raw_drift(machine, t, seed=9)
    follow = method.follow(SpindleDriftSettings(spin_up=0.0))
    for begin in range(0, t.size, 70):
        text = follow(raw.isel(time=slice(begin, begin + 70)))
    last = np.asarray(method.identify(raw).em.at([0, 0, 0]).em.twist())[-1]
    assert f"EZ {last[2] * 1e6:+.2f} um" in text


# ------------------------------------------------------------------ starting and stopping


def test_run_out_after_a_stop_is_part_of_the_uncertainty(method):
    machine = VirtualMachine("cframe", seed=4)
    machine.start([Event(0.0, 15000.0), Event(8.0, 0.0)])
    rate, seconds = 2500.0, 16
    n = int(rate * seconds)
    raw = simulation.raw_drift(machine, np.arange(n) / rate, seed=0, averaged=1)
    raw["distance"] = (("channel", "time"), machine.distances(0, n, rate))
    raw["spindle_speed"] = ("time", np.where(np.arange(n) / rate < 8.0, 15000.0, 0.0))
    errors = method.identify(raw, SpindleDriftSettings(compensate_frame=False))
    u = np.sqrt(errors["covariance"].sel(dof="EX", dof_="EX").values)
    time = errors["time"].values + errors.attrs["reference_time"]
    unknown = np.isnan(errors["EX"].values)
    np.testing.assert_array_equal(unknown, (time < 1.0) | ((time > 7.9) & (time < 9.0)))
    rest, runs = time > 9.0, (time > 2.0) & (time < 7.9)
    off = np.abs(errors["EX"].values[rest])
    assert off.min() > 5 * u[runs].max()  # where it stopped, the bar stands off by its run-out
    assert (off < 3 * u[rest]).all()
    assert "run-out at rest" in errors["source_group"].values
    # One draw for the whole rest: two instants of it differ by their own noise alone.
    weights = np.zeros(time.size)
    weights[np.flatnonzero(rest)[[0, -1]]] = -1.0, 1.0
    spread = np.asarray(errors.where(~unknown.any(), errors).em.combine(weights, dim="time")[1])[0, 0]
    assert np.sqrt(spread) < 0.1 * u[rest].min()


def test_each_rest_is_an_independent_draw_and_a_resting_reference_affects_all_others(method):
    """Cold and still, then running, then still again: the bar stops at another angle than it started from."""
    machine = VirtualMachine("cframe", seed=4)
    machine.start([Event(6.0, 15000.0), Event(12.0, 0.0)])
    rate, seconds = 2500.0, 18
    n = int(rate * seconds)
    clock = np.arange(n) / rate
    raw = simulation.raw_drift(machine, clock, seed=0, averaged=1)
    raw["distance"] = (("channel", "time"), machine.distances(0, n, rate))
    raw["spindle_speed"] = ("time", np.where((clock < 6.0) | (clock >= 12.0), 0.0, -15000.0))
    errors = method.identify(raw, SpindleDriftSettings(compensate_frame=False))
    time = errors["time"].values + errors.attrs["reference_time"]
    u = np.sqrt(errors["covariance"].sel(dof="EX", dof_="EX").values)
    first, running, last = (time > 2) & (time < 5.5), (time > 8) & (time < 11.5), time > 14
    assert u[running].min() > 5 * u[first].max()
    np.testing.assert_allclose(u[last], np.sqrt(2) * u[running].mean(), rtol=0.02)
    off = np.abs(errors["EX"].values)
    assert (off[running] < 3 * u[running]).all()
    assert (off[last] < 3 * u[last]).all()


def test_errors_of_the_smoothed_frame_temperature_are_correlated(machine, method):
    """Means over half a minute share their smoothed temperature: their difference over seeds is what is stated."""
    t = np.arange(0, 420.0, 2.0)
    late, later = (t > 150) & (t <= 180), (t > 350) & (t <= 380)
    weights = later / later.sum() - late / late.sum()
    found, stated = [], []
    raw = simulation.raw_drift(machine, t, seed=0, expansion=True)
    raw["frame_expansion"] = (("channel", "direction"), machine.frame.expansion)
    warm = raw["temperature"].sel(sensor="frame").values.copy()
    column = list(raw["sensor"].values).index("frame")
    settings = SpindleDriftSettings(frame_expansion_uncertainty=0.0, frame_smoothing=60.0)
    for seed in range(40):
        raw["temperature"][:, column] = warm + np.random.default_rng(seed).normal(0, 0.03, t.size)
        change = method.identify(raw, settings).em.combine(weights, dim="time")
        found.append(np.asarray(change[0])[1])
        stated.append(np.sqrt(np.asarray(change[1])[1, 1]))
    # The readings' noise is the same in all seeds; of the spread of 40 draws 11 % is chance.
    assert np.std(found) == pytest.approx(np.mean(stated), rel=0.4)


def test_whole_curve_agrees_with_the_truth_with_a_noisy_frame_temperature(method):
    """Jointly, on the grid of the method: errors that neighbours do not share must be in their own covariance."""
    t = np.arange(0, 7200.0, 20.0)
    square, degrees = 0.0, 0
    for seed in range(4):
        machine = VirtualMachine("cframe", seed=seed)
        machine.start([Event(0.0, 15000.0)])
        beams = simulation.calibrated_beams(machine, seed)
        raw = simulation.raw_drift(machine, t, seed=seed, beams=beams, expansion=True, warm_up=False)
        raw["frame_expansion"] = (("channel", "direction"), machine.frame.expansion)
        column = list(raw["sensor"].values).index("frame")
        raw["temperature"][:, column] += np.random.default_rng(seed).normal(0, 0.02, t.size)
        errors = method.identify(raw, SpindleDriftSettings(noise="stated"))
        truth = np.asarray(machine.truth_spindle(t, errors.attrs["functional_point"]).em.twist())
        influence = errors["influence"].transpose("source", "time", "dof").values[..., SEEN]
        own = errors["covariance"].values[:, SEEN, SEEN] - np.einsum("sti,stj->tij", influence, influence)
        white = whitener(own, influence)
        square += white.square(np.asarray(errors.em.twist())[:, SEEN] - (truth - truth[0])[:, SEEN])
        degrees += white.degrees
    # Of 7200 degrees of freedom 1 % is chance; the independent share errs on the safe side by a few per cent.
    assert np.sqrt(square / degrees) == pytest.approx(1.0, abs=0.1)


# ------------------------------------------------------------------ what a lab does wrong


def test_beams_given_from_the_bar_to_the_sensor_are_refused(machine, method):
    raw = simulation.raw_drift(machine, TIMES, seed=0)
    raw["beam_direction"] = -raw["beam_direction"]
    with raises("drift.beam.opposite"):
        method.identify(raw)


@pytest.mark.parametrize("channel", [0, 3, 4])
def test_one_reversed_beam_is_detected(machine, method, channel):
    raw = simulation.raw_drift(machine, TIMES, seed=0)
    # Reversed about the point that it sees, so that all five still meet the bar.
    seen = raw["beam_origin"].values[channel] + raw["beam_direction"].values[channel] * 1e-3
    raw["beam_direction"][channel] *= -1.0
    raw["beam_origin"][channel] = seen - raw["beam_direction"].values[channel] * 1e-3
    with raises("drift.beam.opposite"):
        method.identify(raw)


def test_equal_levels_are_refused(machine, method):
    raw = simulation.raw_drift(machine, TIMES, seed=0)
    raw["level"] = ("height", [0.01, 0.01])
    with raises("drift.levels.too_close"):
        method.identify(raw)


def test_record_of_one_mean_is_refused(machine, method):
    raw = simulation.raw_drift(machine, np.arange(0, 2, 1 / 500), seed=0)
    with raises("drift.record.too_short"):
        method.identify(raw, SpindleDriftSettings(average=1.5))


def test_stated_noise_of_zero_is_replaced_by_the_observed_noise(machine, method):
    raw = simulation.raw_drift(machine, np.arange(0, 200, 0.5), seed=6)
    honest = method.identify(raw)
    raw["distance_noise"] = 0.0
    doubted = method.identify(raw)
    np.testing.assert_allclose(
        np.sqrt(doubted["covariance"].sel(dof="EZ", dof_="EZ").values[1:]),
        np.sqrt(honest["covariance"].sel(dof="EZ", dof_="EZ").values[1:]),
        rtol=0.15,
    )
