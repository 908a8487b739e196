"""The measurement model of a drift: its derivatives, and what states its constants."""

import json

import numpy as np
import pytest

from errormotion.errors import MethodError
from errormotion.estimation.derivatives import along, by_rows
from errormotion.instruments.spindle_frame.settings import FrameSettings
from errormotion.methods.spindle_drift import SpindleDrift, SpindleDriftSettings, simulation
from errormotion.methods.spindle_drift.model import observe
from errormotion.montecarlo.trials import trial, trial_model_of
from errormotion.twin import Event, VirtualMachine

TIMES = 10.0 * np.arange(60)


@pytest.fixture(scope="module")
def machine():
    machine = VirtualMachine("cframe", seed=3)
    machine.start([Event(0.0, 15000.0)])
    return machine


@pytest.fixture
def warming(machine):
    """Return a record with all sources but rests: beams, a frame that expands, and its noisy temperature."""
    raw = simulation.raw_drift(
        machine, TIMES, seed=2, beams=simulation.calibrated_beams(machine, 2), expansion=True, warm_up=False
    )
    raw["frame_expansion"] = (("channel", "direction"), machine.frame.expansion)
    column = list(raw["sensor"].values).index("frame")
    raw["temperature"][:, column] += np.random.default_rng(1).normal(0, 0.02, TIMES.size)
    return raw


def test_analytic_derivatives_are_those_of_differences(warming):
    problem = observe(
        warming, SpindleDriftSettings(bar_radius_uncertainty=1e-6, gain_uncertainty=1e-3, frame_smoothing=60.0)
    ).problem
    values = [*problem.start.tables, *problem.constant_tables(problem.start)]
    rows = [table.rows(value) for table, value in zip(problem.tables, values, strict=True)]
    x, c = problem.named(rows[:2], rows[2:])
    given = {**problem.derivatives(problem.y, x, c), **problem.constant_derivatives(problem.y, x, c)}
    names = [*problem.unknowns._fields, *problem.constants._fields]
    found = by_rows(lambda each: problem.evaluate(problem.y, each), problem.tables, values, range(len(names)))
    for name, numeric in zip(names, found, strict=True):
        analytic = given[name].reshape(numeric.shape)
        # Differences are accurate to some 1e-10 of the largest derivative.
        np.testing.assert_allclose(analytic, numeric, rtol=0, atol=2e-9 * max(np.abs(numeric).max(), 1e-300))
    numeric = along(lambda y: problem.evaluate(y, rows), problem.y, problem.reading_scale)
    for k in range(6):
        limit = 2e-9 * np.abs(numeric[..., k]).max()
        np.testing.assert_allclose(given["readings"][..., k], numeric[..., k], rtol=0, atol=limit)


def test_one_draw_of_every_constant_changes_the_errors_as_its_influence_states(warming):
    """Against the identification of changed raw data: beams, radius and expansion of the frame, one at a time."""
    method = SpindleDrift()
    settings = SpindleDriftSettings(bar_radius_uncertainty=1e-6, functional_point=(0.0, 0.0, 0.0), noise="stated")
    errors = method.identify(warming, settings)
    effects = errors["influence"].transpose("source", "time", "dof").values
    rows = dict(zip(errors["source"].values.tolist(), effects, strict=True))
    u = np.sqrt(np.diagonal(errors["covariance"].values, axis1=1, axis2=2))[1:, :5]

    def moved(**changes):
        changed = method.identify(warming.assign(changes), settings)
        return (changed.em.twist().values - errors.em.twist().values)[1:, :5]

    C = warming["beam_covariance"].values[0]
    size = np.sqrt(np.diag(C))
    unit = np.where(size > 0, size, 1.0)
    power, vectors = np.linalg.eigh(C / np.outer(unit, unit))
    origin, direction = warming["beam_origin"].copy(deep=True), warming["beam_direction"].copy(deep=True)
    part = unit * vectors[:, -1] * np.sqrt(power[-1])
    origin[0] += part[:3]
    direction[0] += part[3:]
    # The directions have their length again: a part along the beam, of second order.
    for name, change in {
        "beam X1.5": moved(beam_origin=origin, beam_direction=direction),
        "bar radius": moved(bar_radius=warming["bar_radius"] + 1e-6),
        "frame expansion": moved(frame_expansion=1.1 * warming["frame_expansion"]),
    }.items():
        stated = rows[name][1:, :5] / u
        # The effect is linear but for the square of a change: of an angle of 0.6 mrad, or of a tenth of the expansion.
        np.testing.assert_allclose(change / u, stated, rtol=0, atol=0.02 * np.abs(stated).max())


def test_an_unknown_temperature_of_the_frame_in_the_reference_state_is_reported(warming):
    warming["temperature"][0] = np.nan
    with pytest.raises(MethodError, match=r"temperature of the frame \(frame\) is unknown in the reference state"):
        SpindleDrift().identify(warming)
    SpindleDrift().identify(warming, SpindleDriftSettings(compensate_frame=False))
    SpindleDrift().identify(warming, SpindleDriftSettings(reference_time=100.0))


def test_readings_without_noise_have_no_infinite_weight(machine):
    raw = simulation.raw_drift(machine, TIMES[:10], seed=1)
    raw["distance_noise"] = 0.0
    errors = SpindleDrift().identify(raw, SpindleDriftSettings(noise="stated"))
    u = np.sqrt(errors["covariance"].sel(dof="EX", dof_="EX").values)
    assert np.isfinite(errors["EX"].values).all()
    assert u.max() < 1e-8  # the unknown rotation about the axis remains


@pytest.mark.parametrize("shift", [0.0, 0.7])
def test_precise_readings_far_from_the_origin_of_the_machine_are_solved(machine, shift):
    """Rounding of coordinates of a metre is larger than the decrement that ends a fit to readings of 20 pm."""
    raw = simulation.raw_drift(machine, np.linspace(0.0, 600.0, 2000), seed=1, averaged=200_000_000, warm_up=False)
    raw["beam_origin"] = raw["beam_origin"] + shift
    raw["level"] = raw["level"] + shift
    errors = SpindleDrift().identify(raw, SpindleDriftSettings(noise="stated"))
    assert np.isfinite(errors["EX"].values).all()


def test_errors_within_a_reference_state_of_several_means_have_their_spread(warming):
    """By draws: each mean shares its noise with the reference state, and the temperature of the frame differs."""
    method = SpindleDrift()
    settings = SpindleDriftSettings(
        reference_time=0.0, reference_average=100.0, noise="stated", functional_point=(0.0, 0.0, 0.0)
    )
    errors = method.identify(warming, settings)
    trial_model = trial_model_of(method, warming, settings, errors)
    draws = [trial(method, trial_model, np.random.SeedSequence(k)).em.twist().values[:11, :5] for k in range(150)]
    u = np.sqrt(np.diagonal(errors["covariance"].values, axis1=1, axis2=2))[:11, :5]
    # Of 150 draws 6 % is chance, and 4 times as much in 55 values.
    np.testing.assert_allclose(np.std(draws, axis=0, ddof=1) / u, 1.0, atol=0.24)


def test_a_single_mean_as_the_reference_state_is_exactly_0(warming):
    errors = SpindleDrift().identify(warming)
    assert (errors.em.twist().values[0, :5] == 0.0).all()
    assert (errors["covariance"].values[0, :5, :5] == 0.0).all()
    assert (errors["influence"].isel(time=0, dof=slice(0, 5)) == 0.0).all()


EXPANDING = {"frame_expansion": (2.1e-6, 2.4e-6, 1.3e-6)}


@pytest.mark.parametrize(
    "settings",
    [
        SpindleDriftSettings(),
        SpindleDriftSettings(layout=EXPANDING, bar_radius_uncertainty=1e-6),
        SpindleDriftSettings(layout=EXPANDING, reference_time=60.0, reference_average=30.0),
        SpindleDriftSettings(beams="nominal"),
        SpindleDriftSettings(procedure="beam_detection"),
    ],
    ids=["plain", "expanding", "averaged", "nominal", "beams"],
)
def test_plan_is_the_identification_of_the_expected_data(settings):
    method = SpindleDrift()
    planned, found = method.plan(settings), method.identify(method.expected(settings), settings)
    if "source_group" in found:
        assert planned["source_group"].values.tolist() == found["source_group"].values.tolist()
    np.testing.assert_allclose(planned["covariance"], found["covariance"], rtol=1e-9, atol=1e-30)
    assert not np.nan_to_num(planned.em.twist().values).any()


def test_plan_of_a_frame_that_expands_states_the_largest_part_of_the_uncertainty():
    """A tenth of 2.1 um: without it, the plan of EX is 5 nm."""
    u = [
        np.sqrt(SpindleDrift().plan(SpindleDriftSettings(layout=layout))["covariance"].values[-1, 0, 0])
        for layout in ({}, EXPANDING)
    ]
    assert u[0] < 10e-9
    assert u[1] == pytest.approx(0.1 * 2.1e-6, rel=0.05)


def test_a_longer_reference_state_decreases_its_planned_part():
    plans = [SpindleDrift().plan(SpindleDriftSettings(reference_average=length)) for length in (0.5, 50.0)]
    parts = []
    for plan in plans:
        rows = plan["influence"].values[plan["source_group"].values == "reference state"]
        parts.append(np.linalg.norm(rows[:, -1, :3]))
    assert parts[1] == pytest.approx(parts[0] / 10.0, rel=1e-3)


def test_the_plan_of_a_campaign_has_the_frame_of_the_bench():
    method = SpindleDrift()
    frame = FrameSettings(expansion=(2.1e-6, 2.4e-6, 1.3e-6), bar_radius=6e-3)
    warm = method.planning_settings(SpindleDriftSettings(), {"spindle_frame": frame, "thermometer": object()}).layout
    assert warm.frame_expansion == frame.expansion
    assert (warm.bar_radius, warm.levels, warm.noise) == (6e-3, frame.levels, frame.noise)
    # Without a thermometer nothing is corrected; what the campaign states is kept.
    assert method.planning_settings(SpindleDriftSettings(), {"spindle_frame": frame}).layout.frame_expansion == (
        0.0,
        0.0,
        0.0,
    )
    stated = method.planning_settings(
        SpindleDriftSettings(layout={"bar_radius": 4e-3}), {"spindle_frame": frame}
    ).layout
    assert stated.bar_radius == 4e-3
    assert method.planning_settings(SpindleDriftSettings(), {}).layout == SpindleDriftSettings().layout


def test_a_drift_has_the_relative_uncertainty_of_the_gain(warming):
    """EZ follows from one sensor that looks along the axis; two records with the same sensors share their gains."""
    warming.attrs["certificates"] = json.dumps({"sensor": "S-5"})
    settings = SpindleDriftSettings(gain_uncertainty=2e-3, compensate_frame=False, functional_point=(0.0, 0.0, 0.0))
    errors = SpindleDrift().identify(warming, settings)
    row = errors["influence"].sel(source="gain Z", dof="EZ").values
    # But for the tilt over the distance of the beam from the axis: some nanometres of some micrometres.
    np.testing.assert_allclose(row[1:], 2e-3 * errors["EZ"].values[1:], rtol=2e-3)
    ids = dict(zip(errors["source"].values.tolist(), errors["source_id"].values.tolist(), strict=True))
    assert ids["gain Z"] == "certificate S-5: sensor, gain Z"
    assert set(errors["source_group"].values) == set(SpindleDrift().plan(settings)["source_group"].values)
    changed = warming.assign(
        distance=1.002 * warming["distance"].where(warming["channel"] == "Z", warming["distance"] / 1.002)
    )
    moved = SpindleDrift().identify(changed, settings)
    np.testing.assert_allclose((moved["EZ"] - errors["EZ"]).values[1:], row[1:], rtol=1e-3)
