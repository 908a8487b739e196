"""From raw data to an error dataset: true errors, datum, scale, returns, and messages for wrong input."""

import numpy as np
import pytest
from coded import raises
from scipy import stats

from errormotion import datasets
from errormotion.errors import DatasetError, MethodError
from errormotion.methods.multilateration import Multilateration, MultilaterationSettings, simulation
from errormotion.methods.multilateration.axes import diagonals, grid, volumetric_errors
from errormotion.methods.multilateration.refraction import refractive_index
from errormotion.twin import VirtualMachine

XYZ = ("EX", "EY", "EZ")


@pytest.fixture(scope="module")
def machine():
    return VirtualMachine("cframe", seed=3)


@pytest.fixture(scope="module")
def raw(machine):
    return simulation.raw(machine, seed=1)


@pytest.fixture(scope="module")
def errors(raw):
    return Multilateration().identify(raw)


def vectors(ds):
    return np.stack([ds[name].values for name in XYZ], axis=-1)


def spread(ds):
    return np.sqrt(np.einsum("tii->ti", ds["covariance"].values[:, :3, :3]))


STILL_AIR = {"temperature_uncertainty": 0.0, "pressure_uncertainty": 0.0, "humidity_uncertainty": 0.0}


def notes(ds):
    return "\n".join(ds.attrs["notes"])


def test_targets_agree_with_the_true_ones_within_their_uncertainty(machine, errors):
    truth = simulation.true_errors(machine, simulation.target_grid(machine))
    left = vectors(errors) - vectors(truth)
    chi2 = sum(e @ np.linalg.solve(C[:3, :3], e) for e, C in zip(left, errors["covariance"].values, strict=True))
    # 300 values of which stations share ten directions: the mean of chi-square to 3 sigma of some 60 freedoms.
    assert chi2 / left.size == pytest.approx(1.0, abs=0.55)
    assert np.all(np.abs(left) < 5 * spread(errors))


def test_the_result_is_an_error_dataset_with_all_variables_of_the_report(raw, errors):
    datasets.validate(errors)
    assert (errors.attrs["component"], errors.attrs["machine"]) == ("tool", "C-frame 610")
    assert "six rigid motions of the whole" in errors.attrs["reference"]
    np.testing.assert_array_equal(errors.attrs["functional_point"], raw["reflector"].values[0])
    for name in ("station_place", "station_covariance", "dead_path", "residual", "left_out", "condition"):
        assert name in errors
    assert np.isnan(errors["EA"].values).all()
    assert list(errors.em.budget()["group"].values) == [
        "stations",
        "refraction",
        "scale of the tracker",
        "targets",
        "independent",
    ]
    assert "ECY: not distinguishable from EXY" in notes(errors)
    assert errors["ECY"].attrs["unseen"] == "not distinguishable from EXY"
    assert "ECY" in errors["EXY"].attrs["includes"]
    assert errors["EYX"].attrs["includes"] == ""


def test_the_figures_are_the_volumetric_error_and_the_squareness(errors):
    size = np.linalg.norm(vectors(errors), axis=1)
    largest, rms, *square = Multilateration.figures(errors)
    assert largest.value == size.max()
    assert str(errors["target"].values[size.argmax()]) in largest.name
    assert rms.value == pytest.approx(np.sqrt(np.mean(size**2)))
    assert 0 < rms.expanded_uncertainty < largest.expanded_uncertainty
    found = {figure.name: (figure.value, figure.expanded_uncertainty, figure.unit) for figure in square}
    expected = {
        f"squareness {name}": (float(errors[name]), 2 * float(errors[f"{name}_u"]), "rad")
        for name in ("EA0Z", "EB0Z", "EC0Y")
    }
    assert found == expected
    assert Multilateration.figures(volumetric_errors(errors, [[0.0, 0.0, 0.2]]))[0].value > 0


def test_the_datum_has_no_rigid_motion(raw, errors):
    e, place = vectors(errors), raw["target_nominal"].values
    place = place - place.mean(axis=0)
    assert np.abs(e.mean(axis=0)).max() < 1e-12
    # The fit is a rotation, not its first order: errors of 1e-5 m leave their square.
    assert np.abs(np.cross(place, e).mean(axis=0)).max() < 1e-10


def test_stations_and_dead_paths_are_determined(machine, raw, errors):
    off = errors["station_place"].values - simulation.stations(machine)
    u = np.sqrt(np.einsum("sii->si", errors["station_covariance"].values))
    # The datum is that of the targets: their true errors turn the stations by some 10 um.
    assert np.abs(off).max() < 60e-6
    assert np.all(u < 5e-6)
    assert np.all(np.abs(raw["station_nominal"].values - simulation.stations(machine)).max(axis=1) > 1e-3)


def test_stations_require_no_approximate_positions(raw, errors):
    anywhere = Multilateration().identify(raw.drop_vars("station_nominal"))
    # The last step of an iteration, not the start, decides: rounding of some 1e-12 m.
    np.testing.assert_allclose(vectors(anywhere), vectors(errors), atol=1e-10)


# ---------------------------------------------------------------- the axes and the volume


def test_the_volume_between_the_targets_follows_from_the_axes(machine, errors):
    q = grid(errors["axes_low"].values, errors["axes_high"].values, (4, 3, 3))
    volume = volumetric_errors(errors, q)
    datasets.validate(volume)
    measured, both = simulation.target_grid(machine), np.concatenate([simulation.target_grid(machine), q])
    truth = vectors(simulation.true_errors(machine, both))
    # The truth of both sets, brought into the datum of the measured one.
    place = both + errors.attrs["functional_point"]
    shift = _motion(place[: len(measured)], truth[: len(measured)], place)
    left = vectors(volume) - (truth - shift)[len(measured) :]
    assert np.mean(np.abs(left) < 2 * spread(volume)) > 0.85
    at_targets = volumetric_errors(errors, simulation.target_grid(machine))
    assert spread(at_targets).mean() < spread(errors).mean()


def _motion(place, error, everywhere):
    centre = place.mean(axis=0)

    def columns(at):
        x, y, z = (at - centre).T
        zero, one = np.zeros_like(x), np.ones_like(x)
        rows = [[one, zero, zero, zero, z, -y], [zero, one, zero, -z, zero, x], [zero, zero, one, y, -x, zero]]
        return np.moveaxis(np.array(rows), 2, 0)

    motion = np.linalg.lstsq(columns(place).reshape(-1, 6), error.ravel())[0]
    return columns(everywhere) @ motion


def test_errors_outside_the_measured_volume_are_unknown(errors):
    volume = volumetric_errors(errors, [errors["axes_high"].values + 0.01, errors["axes_low"].values])
    assert np.isnan(vectors(volume)[0]).all()
    assert np.isfinite(vectors(volume)[1]).all()
    assert "outside" in notes(volume)


def test_another_tool_requires_errors_that_one_reflector_does_not_determine(errors):
    here, there = (volumetric_errors(errors, [[0.0, 0.0, 0.2]], tool) for tool in (None, (0.02, -0.01, -0.2)))
    assert np.isfinite(vectors(here)).all()
    assert np.isnan(vectors(there)[0, :2]).all()  # EAZ and EBZ swing the longer tool


def test_diagonals_are_from_corner_to_corner():
    lines = diagonals((0, 0, 0), (1, 2, 3), 3)
    assert lines.shape == (4, 3, 3)
    np.testing.assert_array_equal(lines[3], [(1, 2, 0), (0.5, 1, 1.5), (0, 0, 3)])
    np.testing.assert_array_equal(lines[:, 1], np.tile((0.5, 1, 1.5), (4, 1)))


def test_without_a_chain_there_are_no_axes(raw):
    blank = {key: value for key, value in raw.attrs.items() if key != "chain"}
    found = Multilateration().identify(raw.drop_attrs().assign_attrs(blank))
    assert "EXX" not in found
    assert "chain of the machine is unknown" in notes(found)
    with raises("network.no_errors_of_axes"):
        volumetric_errors(found, [[0.0, 0.0, 0.1]])


# ---------------------------------------------------------------- scale


def test_the_uncertainty_of_the_scale_is_in_the_budget(raw):
    found = Multilateration().identify(raw, MultilaterationSettings(scale_uncertainty="2 um/m", air=STILL_AIR))
    budget = found.em.budget()
    assert list(budget["group"].values) == [
        "stations",
        "refraction",
        "scale of the tracker",
        "targets",
        "independent",
    ]
    place = raw["target_nominal"].values
    shape = 2e-6 * (place - place.mean(axis=0))
    np.testing.assert_allclose(np.abs(budget.values[2][:, :3]), np.abs(shape), atol=1e-9)


def test_assumed_uncertainties_are_noted_and_change_no_value(raw, errors):
    exact = Multilateration().identify(raw, MultilaterationSettings(scale_uncertainty=0.0, air=STILL_AIR))
    assert "an uncertainty of the tracker's lengths of 0.5 um/m (scale_uncertainty)" in notes(errors)
    assert "an uncertainty of the air of 0.2 K of its temperature, 50 Pa of its pressure, 5 %" in notes(errors)
    assert "Assumed" not in notes(exact)
    np.testing.assert_array_equal(vectors(errors), vectors(exact))
    place = raw["target_nominal"].values
    # 0.2 K, 50 Pa and 5 % are 0.24 um/m of the air, with 0.5 um/m 0.55 um/m.
    further = np.sqrt(spread(errors) ** 2 - spread(exact) ** 2)
    np.testing.assert_allclose(further, 0.55e-6 * np.abs(place - place.mean(axis=0)), rtol=0.02, atol=2e-9)


def test_scale_errors_of_a_tracker_that_states_none_are_within_the_uncertainty(machine):
    """The noise is that of a good interferometer, so that a scale that is not in U would miss the outer targets."""
    q = simulation.target_grid(machine, (4, 4, 3))
    truth, held = vectors(simulation.true_errors(machine, q)), []
    outer = np.abs(q - q.mean(axis=0)) > 0.9 * np.abs(q - q.mean(axis=0)).max(axis=0)
    for seed in range(20):
        scale = 0.5e-6 * float(np.random.default_rng(seed).normal())
        raw = simulation.raw(machine, q, seed=seed, noise=0.02e-6, scale=scale)
        found = Multilateration().identify(raw, MultilaterationSettings(parametric=False))
        held.append(np.mean((np.abs(vectors(found) - truth) < 1.96 * spread(found))[outer]))
    # 20 independent scale errors, of which 95 % are within the interval: 4 sigma of their share are 0.2.
    assert np.mean(held) > 0.75


def test_what_is_assumed_of_reflector_expansion_and_chain_is_noted(raw, errors):
    blank = Multilateration().identify(raw.drop_vars("reflector"))
    assert "with all axes at zero the reflector is at zero (reflector)" in notes(blank)
    assert "reflector is at zero" not in notes(errors)
    np.testing.assert_array_equal(vectors(blank), vectors(errors))
    assert "temperature of the measurement" in notes(errors)
    warm = Multilateration().identify(
        raw, MultilaterationSettings(expansion={"coefficient": 11.5e-6, "temperature": 23.0})
    )
    assert "temperature of the measurement" not in notes(warm)
    assert "of the scales of 1 um/m/K (expansion.coefficient_uncertainty)" in notes(warm)
    other = "workpiece-bed-Z-Y-X-spindle-tool"
    turned = Multilateration().identify(raw, MultilaterationSettings(chain=other))
    assert f"The data state the chain {raw.attrs['chain']}; the setting {other} is used." in notes(turned)


def test_mirrored_axes_are_noted_at_every_station_and_opposite_readings_refused(raw):
    mirror = np.array([-1.0, 1.0, 1.0])
    for name in ("target_nominal", "station_nominal"):
        mirrored = raw.assign({name: (raw[name].dims, raw[name].values * mirror, raw[name].attrs)})
        found = notes(Multilateration().identify(mirrored, MultilaterationSettings(parametric=False)))
        assert all(f"Station S{k} is " in found for k in (1, 2, 3, 4))
    opposite = raw.assign(displacement=(raw["displacement"].dims, -raw["displacement"].values, {"units": "m"}))
    with pytest.raises(MethodError, match="opposite sign: a displacement increases with the distance"):
        Multilateration().identify(opposite)


def test_lengths_in_vacuum_are_converted_to_lengths_in_air(raw, errors):
    shape = raw["displacement"].shape
    air = {"air_temperature": (23.0, "degC"), "air_pressure": (98e3, "Pa"), "relative_humidity": (0.4, "1")}
    n = float(refractive_index(23.0, 98e3, 0.4))
    optical = raw.assign(
        {name: (("station", "target"), np.full(shape, value), {"units": unit}) for name, (value, unit) in air.items()}
    )
    optical["displacement"] = (raw["displacement"] * n).assign_attrs(units="m")
    optical["refractive_index"] = ("station", "target"), np.ones(shape), {"units": "1"}
    found = Multilateration().identify(optical)
    np.testing.assert_allclose(vectors(found), vectors(errors), atol=1e-11)
    # 0.2 K is 0.19 um/m, 50 Pa 0.13 um/m.
    assert "refraction" in found.em.budget()["group"].values
    with raises("network.air.incomplete"):
        Multilateration().identify(optical.drop_vars("air_pressure"))


def test_scales_are_corrected_to_20_degrees(raw, errors):
    warm = {"coefficient": 11.5e-6, "temperature": 23.0, "coefficient_uncertainty": 1e-6}
    found = Multilateration().identify(raw, MultilaterationSettings(expansion=warm))
    position = raw["target_nominal"].values
    shape = 3 * 11.5e-6 * (position - position.mean(axis=0))
    # Second order: errors turn the beams by 1e-5.
    np.testing.assert_allclose(vectors(found), vectors(errors) - shape, atol=2e-9)
    assert "scales" in found.em.budget()["group"].values
    with raises("expansion.temperature.missing"):
        Multilateration().identify(raw, MultilaterationSettings(expansion={"coefficient": "11.5 um/m/K"}))


# ---------------------------------------------------------------- returns


def test_drift_during_the_set_ups_is_subtracted(machine):
    q = simulation.target_grid(machine, (4, 4, 3))
    q = np.concatenate([q, q[::3]])
    rate = np.array([(2e-8, 0, 0, 0), (0, 6e-8, 0, 0), (0, 0, 0, -6e-8), (3e-8, 0, 0, 0)])
    truth = vectors(simulation.true_errors(machine, q))
    raw = simulation.raw(machine, q, seed=5, drift=rate)
    found = Multilateration().identify(raw)
    left = vectors(found) - truth
    assert np.mean(np.abs(left) < 1.96 * spread(found)) > 0.85
    assert np.sqrt(np.mean(left**2)) < 2e-6
    assert "drift" in found.em.budget()["group"].values
    with pytest.raises(MethodError, match="A drifting set-up has the same effect"):
        Multilateration().identify(raw, MultilaterationSettings(drift="none"))


def test_repeatability_of_the_machine_is_noise_with_separate_set_ups(machine):
    raw = simulation.raw(machine, seed=6, repeatability=2e-6)
    stated = Multilateration().identify(raw, MultilaterationSettings(repeatability="2 um"))
    raised = Multilateration().identify(raw)
    truth = vectors(simulation.true_errors(machine, simulation.target_grid(machine)))
    for found in (stated, raised):
        assert np.mean(np.abs(vectors(found) - truth) < 1.96 * spread(found)) > 0.88
    assert "The distances scatter" in notes(raised)
    assert "The distances scatter" not in notes(stated)
    assert raised["scatter_share"]["cause"].values.tolist() == ["stations", "unexplained scatter"]
    share = stated["scatter_share"].sel(cause="repeatability")
    assert float(share) == pytest.approx(4 / 4.25)  # 2 um beside the tracker's 0.5 um


def _returning(machine, seed, true, returns=6, **reported):
    q = simulation.target_grid(machine, (4, 4, 3))
    q = np.concatenate([q, q[:: 48 // returns][:returns]])
    raw = simulation.raw(machine, q, seed=seed, repeatability=true)
    left = Multilateration().identify(raw, MultilaterationSettings(parametric=False, **reported))
    return left, vectors(left) - vectors(simulation.true_errors(machine, q))


def test_returns_determine_the_repeatability_with_correct_intervals():
    held, squares, found, sources = [], [], [], []
    for seed in range(40):
        errors, left = _returning(VirtualMachine("cframe", seed=seed), seed, 2e-6)
        held.append(np.mean(np.abs(left) < 1.96 * spread(errors)))
        found.append((float(errors["repeatability"]) - 2e-6) / float(errors["repeatability_u"]))
        e, C = left[7], errors["covariance"].values[7, :3, :3]
        squares.append(e @ np.linalg.solve(C, e))
        sources.append(errors["repeatability"].attrs["source"])
    # Both agree but for a false alarm of 2 %: more than three in forty have a probability of 1 %.
    assert sources.count("returns and residuals") >= 37
    # 40 set-ups of 162 coordinates that share stations: 0.5 % of coverage.
    assert 0.93 < np.mean(held) < 0.97
    low, high = stats.chi2.ppf([1e-3, 1 - 1e-3], 120)
    assert low < sum(squares) < high
    # Known from some 60 freedoms: nearly normal.
    assert abs(np.mean(found)) < 4 / np.sqrt(40)
    assert np.std(found) == pytest.approx(1.0, abs=0.35)


def test_the_share_of_the_repeatability_in_the_noise_is_stated(machine):
    errors, _ = _returning(machine, 11, 2e-6)
    share = errors["scatter_share"]
    assert share["cause"].values.tolist() == ["stations", "repeatability"]
    # As the variances, 2 um to 0.5 um; the repeatability is known to a tenth.
    assert float(share[1] / share[0]) == pytest.approx(16.0, rel=0.6)
    assert float(share.sum()) == pytest.approx(1.0)
    budget = errors.em.budget()
    total = np.sqrt((budget.values**2).sum(axis=0))[:, :3]
    np.testing.assert_allclose(total, spread(errors), rtol=1e-6)
    assert "The repeatability of the machine is" in notes(errors)


def test_stated_repeatability_and_returns_are_weighted_by_their_uncertainties(machine):
    alone, _ = _returning(machine, 12, 2e-6)
    vague, _ = _returning(machine, 12, 2e-6, repeatability="3 um", repeatability_uncertainty="3 um")
    sharp, _ = _returning(machine, 12, 2e-6, repeatability="3 um", repeatability_uncertainty="10 nm")
    exact, _ = _returning(machine, 12, 2e-6, repeatability="3 um")
    assert float(vague["repeatability"]) == pytest.approx(float(alone["repeatability"]), rel=0.05)
    assert float(sharp["repeatability"]) == pytest.approx(3e-6, rel=0.02)
    assert float(exact["repeatability"]) == 3e-6
    assert "settings and returns" in vague["repeatability"].attrs["source"]
    wrong, _ = _returning(machine, 12, 2e-6, repeatability="0.1 um")
    assert "that of the settings 0.1 um" in notes(wrong)


def test_with_simultaneous_stations_repeatability_displaces_the_target(machine):
    q = simulation.target_grid(machine, (4, 4, 3))
    q = np.concatenate([q, q[::4]])
    truth, d = vectors(simulation.true_errors(machine, q)), []
    raw = simulation.raw(machine, q, seed=13)
    rng = np.random.default_rng(1)
    U = simulation.stations(machine)
    moved = 2e-6 * rng.normal(size=(len(q), 3))
    way = simulation.reflector_positions(machine, q) - U[:, None]
    d = np.einsum("jta,ta->jt", way / np.linalg.norm(way, axis=2)[..., None], moved)
    raw["displacement"] = (raw["displacement"] + d).assign_attrs(units="m")
    found = Multilateration().identify(raw, MultilaterationSettings(together=True, parametric=False))
    # 12 returns, 36 coordinates: known to 12 %.
    assert float(found["repeatability"]) == pytest.approx(2e-6, rel=0.4)
    assert 0.9 < np.mean(np.abs(vectors(found) - truth) < 1.96 * spread(found)) < 0.99


# ---------------------------------------------------------------- wrong inputs


def test_swapped_stations_are_noted_and_the_targets_are_correct(raw, errors):
    swapped = raw.copy()
    swapped["station_nominal"] = raw["station_nominal"].isel(station=[1, 0, 2, 3]).drop_vars("station")
    found = Multilateration().identify(swapped)
    assert "swapped" in notes(found)
    np.testing.assert_allclose(vectors(found), vectors(errors), atol=1e-10)


def test_a_station_far_from_its_approximate_position_is_noted(raw, errors):
    astray = raw.copy(deep=True)
    astray["station_nominal"][2] += 0.2
    found = Multilateration().identify(astray)
    assert "Station S3 is 3" in notes(found)  # 346 mm, and 5 mm of the stated position
    np.testing.assert_allclose(vectors(found), vectors(errors), atol=1e-10)


def test_readings_in_millimetres_are_reported(raw):
    small = raw.assign(displacement=raw["displacement"] * 1e3)
    with pytest.raises((MethodError, DatasetError), match=r"in mm, stated as m|in mm\?"):
        Multilateration().identify(small)
    field = raw.assign(displacement=(raw["displacement"] * 1e3).assign_attrs(units="mm"))
    with pytest.raises(DatasetError, match="units 'm'; found 'mm'"):
        Multilateration().identify(field)


def test_one_distance_wrong_by_a_fringe_is_found_with_low_noise(machine):
    raw = simulation.raw(machine, seed=2, station=_five(machine), noise=20e-9)
    sound = Multilateration().identify(raw)
    raw["displacement"][1, 41] += 633e-9 / 2
    found = Multilateration().identify(raw)
    assert int(found["left_out"].sum()) == 1
    assert int(found["left_out"][1, 41]) == 1
    assert np.abs(vectors(found) - vectors(sound)).max() < 100e-9
    assert "Some distances contradict the others (S2 to T042); 1 of them is not used." in notes(found)
    assert "doubts_uncertainty" not in found.attrs


def _five(machine):
    return np.concatenate([simulation.stations(machine), [(0.4, 0.3, 0.6)]])


@pytest.mark.parametrize("moved", [30e-6, 1e-3])
def test_a_station_that_moved_during_its_set_up_is_reported(raw, moved):
    half = raw.copy(deep=True)
    target = raw["target_nominal"].values
    station = raw["station_nominal"].values[1]
    e = (target - station) / np.linalg.norm(target - station, axis=1)[:, None]
    half["displacement"][1, 37:] -= e[37:] @ np.array([moved, -moved, moved])
    with pytest.raises(MethodError, match=r"station S2 was moved by about [\d.]+ mm before target T038\."):
        Multilateration().identify(half)


def test_swapped_readings_are_reported_as_swapped_stations(raw, errors):
    swapped = raw.copy(deep=True)
    swapped["displacement"][[0, 1]] = raw["displacement"].values[[1, 0]]
    found = Multilateration().identify(swapped)
    assert "the readings of station 1 are those of station 2" in notes(found)
    np.testing.assert_allclose(vectors(found), vectors(errors), atol=1e-10)


def test_one_reading_in_millimetres_is_ignored_and_a_station_in_millimetres_is_reported(raw):
    one = raw.copy(deep=True)
    one["displacement"][1, 41] *= 1e3
    found = Multilateration().identify(one)
    assert np.argwhere(found["left_out"].values).tolist() == [[1, 41]]
    whole = raw.copy(deep=True)
    whole["displacement"][1] *= 1e3
    with pytest.raises(DatasetError, match=r"is it in mm\?"):
        Multilateration().identify(whole)


def test_a_fringe_with_four_stations_excludes_the_target_and_affects_no_other(machine):
    raw = simulation.raw(machine, seed=2, noise=20e-9)
    sound = Multilateration().identify(raw, MultilaterationSettings(parametric=False))
    raw["displacement"][1, 41] += 633e-9 / 2
    found = Multilateration().identify(raw, MultilaterationSettings(parametric=False))
    assert np.flatnonzero(np.isnan(found["EX"].values)).tolist() == [41]
    assert "1 of 100 targets are unknown without the distances that are not used: T042" in notes(found)
    assert found["left_out"].values[:, 41].tolist() == [2, 2, 2, 2]
    assert np.nanmax(np.abs(vectors(found) - vectors(sound))) < 100e-9


def test_a_permanent_loss_of_fringes_is_reported_as_a_moved_station(machine):
    raw = simulation.raw(machine, seed=2, station=_five(machine), noise=20e-9)
    raw["displacement"][1, 41:] += 633e-9 / 2
    with pytest.raises(MethodError, match=r"station S2 was moved by about [\d.]+ mm before target T042\."):
        Multilateration().identify(raw, MultilaterationSettings(parametric=False))


def _with_air(raw):
    air = {"air_temperature": (21.0, "degC"), "air_pressure": (1e5, "Pa"), "relative_humidity": (0.4, "1")}
    air["refractive_index"] = (1.00027, "1")
    shape = raw["displacement"].shape
    return raw.assign(
        {name: (("station", "target"), np.full(shape, value), {"units": unit}) for name, (value, unit) in air.items()}
    )


@pytest.mark.parametrize(
    ("name", "row", "message"),
    [
        ("displacement", (slice(None), 7), None),
        ("displacement", (2,), "found none of S3. Remove the station, or measure from it"),
        ("displacement", (slice(None),), "found only NaN. Check that the beam was not broken"),
        ("target_nominal", (7,), "target_nominal: expected numbers; found NaN"),
        ("station_nominal", (2,), None),
        ("reading_time", (2,), None),
        ("reflector", (7,), "reflector: expected a position for every target; found NaN"),
        (
            "air_temperature",
            (1,),
            "found NaN at 100 of 400, first at S2, T001. Add the values, or omit refractive_index",
        ),
        ("air_pressure", (slice(None), 5), "air_pressure: expected a value for every reading"),
        ("refractive_index", (0, 3), "refractive_index: expected a value for every reading"),
    ],
    ids=lambda value: value if isinstance(value, str) and " " not in value else None,
)
def test_rows_of_nan_are_ignored_or_reported(raw, name, row, message):
    broken = (_with_air(raw) if "air" in name or "index" in name else raw).copy(deep=True)
    broken[name][row] = np.nan
    if message is not None:
        with pytest.raises((MethodError, DatasetError), match=message):
            Multilateration().identify(broken, MultilaterationSettings(parametric=False))
        return
    found = Multilateration().identify(broken, MultilaterationSettings(parametric=False))
    lost = np.isnan(found["EX"].values)
    assert np.flatnonzero(lost).tolist() == ([7] if name == "displacement" else [])
    assert np.isfinite(np.sqrt(np.einsum("tii->ti", found["covariance"].values[:, :3, :3]))[~lost]).all()


def test_completely_unknown_air_is_reported(raw):
    without = _with_air(raw).drop_vars("refractive_index")
    without["relative_humidity"][:] = np.nan
    with pytest.raises(MethodError, match="relative_humidity: expected numbers; found only NaN"):
        Multilateration().identify(without)


def test_broken_beams_make_targets_unknown_and_are_counted(raw):
    broken = raw.copy(deep=True)
    broken["displacement"][:, 5] = np.nan
    broken["displacement"][:2, 6] = np.nan
    broken["displacement"][1, 7] = np.nan
    found = Multilateration().identify(broken)
    known = np.isfinite(vectors(found)).all(axis=1)
    assert not known[[5, 6]].any()
    assert known[7]
    assert "2 of 100 targets have fewer than three readings and are unknown: T006, T007" in notes(found)


def test_a_station_without_readings_is_refused(raw):
    silent = raw.copy(deep=True)
    silent["displacement"][3] = np.nan
    with raises("network.station.no_readings"):
        Multilateration().identify(silent)


def test_a_target_in_one_plane_with_its_stations_does_not_affect_the_others(machine):
    station = simulation.stations(machine)
    station[:3, 2] = -0.011  # the height of the lowest reflectors
    raw = simulation.raw(machine, seed=4, station=station)
    raw["displacement"][3, 40] = np.nan  # T041 is among them
    assert raw["target_nominal"].values[40, 2] == pytest.approx(-0.011)
    found = Multilateration().identify(raw)
    assert np.isnan(found["EX"].values[40])
    assert np.isfinite(np.delete(found["EX"].values, 40)).all()
    assert "targets are weakly determined" in notes(found)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda raw: raw.isel(station=slice(3)), "four stations"),
        (lambda raw: raw.isel(target=slice(7)), "at least 10 targets"),
        (
            lambda raw: raw.assign(displacement_noise=((), 0.0, {"units": "m"})),
            "displacement_noise: expected a positive",
        ),
        (lambda raw: raw.assign(displacement=-raw["displacement"]), "sign"),
        (lambda raw: raw.assign(target_nominal=raw["target_nominal"] * 1e3), "target_nominal"),
    ],
    ids=["three stations", "seven targets", "no noise", "sign", "targets in mm"],
)
def test_unsolvable_data_are_refused(raw, change, message):
    with pytest.raises((MethodError, DatasetError), match=message):
        Multilateration().identify(change(raw))


def test_another_schema_is_refused(raw):
    with pytest.raises((MethodError, DatasetError), match="spindle_drift"):
        Multilateration().identify(raw.assign_attrs(schema="errormotion.raw.spindle_drift/1"))
