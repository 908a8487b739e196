"""Thermal distortion by a moving axis after ISO 230-3."""

import numpy as np
import pytest
import xarray as xr
from axis_doubles import Bench, Interferometer, Machine
from coded import raises
from scipy import stats

from errormotion import datasets
from errormotion.datasets.results.merit import figures_of
from errormotion.errors import MethodError
from errormotion.methods.linear_positioning import LinearPositioning, LinearPositioningSettings
from errormotion.methods.linear_positioning.acquisition.warming import measure_moving
from errormotion.methods.linear_positioning.report import chapters
from errormotion.methods.linear_positioning.settings import Moving
from errormotion.report.document import Source

METHOD = LinearPositioning()
SETTINGS = LinearPositioningSettings(moving=Moving(cold=5, duration=7200.0, cooling=1800.0, interval=120.0))
GROWTH_OF_A_METRE = 1e-6
"""Relative expansion of the screw for each metre of fast motion."""


class Screw(Machine):
    """An axis whose screw expands with the distance of fast motion, and that has no other error."""

    def __init__(self):
        super().__init__()
        self.warm_way = 0.0

    def move_to(self, position, feed=None):
        way = abs(position[0] - self.place[0])
        self.warm_way += way * (feed is not None and feed > 0.1)
        self.place = np.array(position, float)
        self.actual = position[0] * (1.0 + GROWTH_OF_A_METRE * self.warm_way)
        self.time += way / (feed or 1.0)
        self.path.append(position[0])


def true_ranges(truth, end):
    """Return the true ranges until ``end``, s, of both ends and of the length between them."""
    curve = truth["EX"].values
    t = np.linspace(0.0, end, 2000)
    both = np.array([np.interp(t, truth["time"].values, curve[:, k]) for k in range(2)])
    return np.ptp(np.vstack([both, both[1] - both[0]]), axis=1)


SIZES = {"at rest": 0.0, "nearly at rest": 0.1, "moving": 1.0}
"""Shares of the simulated drift."""


@pytest.mark.slow
@pytest.mark.parametrize("interval", [120.0, 420.0], ids=["a part of the hour", "no part of the hour"])
def test_true_ranges_lie_within_the_uncertainty(interval):
    settings = SETTINGS.model_copy(
        update={"moving": Moving(cold=5, duration=7200.0, cooling=1800.0, interval=interval)}
    )
    seeds = 200
    held = {(name, measure): np.zeros(3) for name in SIZES for measure in ("range_60min", "range_moving")}
    for seed in range(seeds):
        raw, truth = METHOD.simulate(settings, seed)
        read, hot = raw["end_deviation"].values, raw["reading_time"].values > 0
        times = raw["reading_time"].values[hot]
        drift = np.column_stack([np.interp(times, truth["time"].values, row) for row in truth["EX"].values.T])
        for name, size in SIZES.items():
            changed = read.copy()
            changed[0, hot] -= (1.0 - size) * drift
            errors = METHOD.identify(raw.assign(end_deviation=raw["end_deviation"].copy(data=changed)), settings)
            end = float(errors["time"].values[errors["moving"].values > 0][-1])
            for measure, until in {"range_60min": 3600.0, "range_moving": end}.items():
                found, u = (
                    errors[each].sel(freedom="EXX", measure=measure).values for each in ("distortion", "distortion_u")
                )
                held[name, measure] += np.abs(found - size * true_ranges(truth, until)) <= 2.0 * u
    for case, counts in held.items():
        assert (counts >= stats.binom.ppf(1e-3, seeds, 0.95)).all(), (case, counts)


def test_the_noise_of_a_reading_follows_from_second_differences():
    noise = [
        float(METHOD.identify(METHOD.simulate(SETTINGS, seed)[0], SETTINGS)["reading_noise"][0]) for seed in range(40)
    ]
    assert np.mean(noise) == pytest.approx(0.5e-6, rel=0.05)  # of the plan


def test_a_range_does_not_lag_behind_the_drift():
    raw, _ = METHOD.simulate(SETTINGS, 1)
    t = raw["reading_time"].values
    line = 15e-6 * np.maximum(t, 0.0) / 3600.0
    raw["end_deviation"][0] = np.column_stack([line, 2.0 * line])
    errors = METHOD.identify(raw, SETTINGS)
    found = errors["distortion"].sel(freedom="EXX", measure="range_60min").values
    np.testing.assert_allclose(found, [15e-6, 30e-6, 15e-6], rtol=1e-9)


def test_the_cold_state_is_the_reference():
    errors = METHOD.identify(METHOD.simulate(SETTINGS, 1)[0], SETTINGS)
    assert (errors["EX"].isel(time=0) == 0.0).all()
    assert (errors["covariance"].isel(time=0).sel(dof="EX", dof_="EX") == 0.0).all()
    again = errors.em.since(3600.0)  # the reference cancels between two warm states
    late = errors["covariance"].sel(dof="EX", dof_="EX").isel(time=-1, position=0)
    noise = float(errors["reading_noise"][0])
    assert float(late) == pytest.approx(noise**2 * (1.0 + 1.0 / 5.0), rel=1e-6)
    changed = again["covariance"].sel(dof="EX", dof_="EX").isel(time=-1, position=0)
    assert float(changed) == pytest.approx(2.0 * noise**2, rel=1e-6)


def test_figures_and_report_contain_both_ends():
    errors = METHOD.identify(METHOD.simulate(SETTINGS, 1)[0], SETTINGS)
    names = [figure.name for figure in figures_of(errors)]
    assert "EXX at P2 - P1 within the first 60 min, range (ISO 230-3)" in names
    assert len(names) == 6
    (part,) = chapters(Source(errors))
    table = part.sections[0].blocks[0]
    assert [row[0] for row in table.rows] == ["P1", "P2", "P2 - P1"]
    shown = float(table.rows[1][2].text)  # P2, while it moved
    assert shown == pytest.approx(1e6 * float(errors["distortion"][0, 1, 1]), abs=0.05)


def test_the_expansion_of_a_screw_is_measured_within_the_stroke():
    settings = LinearPositioningSettings(
        travel=(0.0, 0.4),
        dwell=0.5,
        settle=0.2,
        average=1,
        feed=0.05,
        moving=Moving(cold=3, duration=600.0, cooling=120.0, interval=60.0, feed=0.2),
    )
    machine = Screw()
    bench = Bench(controller=machine, interferometer=Interferometer(machine))
    settings = settings.model_copy(update={"channels": {"EX": "-length"}})
    parts = list(measure_moving(bench, settings, None))
    raw = xr.concat(
        parts, dim="cycle", data_vars="minimal", coords="minimal", compat="override", combine_attrs="override"
    )
    raw.attrs.pop("invalid")
    datasets.validate(raw)
    assert raw.sizes["cycle"] == METHOD.progress(settings) == 3 + 10 + 2
    planned = [step.place[0] for step in METHOD.motions(settings) if step.what == "move"]
    assert machine.path == planned
    errors = METHOD.identify(raw, settings)
    np.testing.assert_allclose(errors["EX"].isel(position=0), 0.0, atol=1e-12)
    grown = 0.4 * GROWTH_OF_A_METRE * machine.warm_way
    assert float(errors["EX"][-1, 1]) == pytest.approx(grown, rel=1e-6)
    assert errors["moving"].values.tolist() == [0.0] + 10 * [1.0] + 2 * [0.0]
    (text,) = METHOD.programs(settings).values()
    assert text.count("G4 P0.500") == 2 * 15


def test_an_interrupted_warm_up_is_not_continued():
    raw, _ = METHOD.simulate(SETTINGS, 0)
    with pytest.raises(MethodError, match="the axis has cooled down in the meantime"):
        next(measure_moving(Bench(), SETTINGS, raw))


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda raw: raw.assign(reading_time=raw["reading_time"] + 1e4), "moving_axis.cold.missing"),
        (lambda raw: raw.assign(reading_time=-raw["reading_time"]), "moving_axis.times.not_increasing"),
        (lambda raw: raw.isel(cycle=slice(8)), "moving_axis.cycles.too_few"),
        (lambda raw: raw.assign(end_position=0.0 * raw["end_position"]), "moving_axis.ends.form"),
    ],
)
def test_invalid_data_are_refused_with_the_reason(change, code):
    with raises(code):
        METHOD.identify(change(METHOD.simulate(SETTINGS, 0)[0]), SETTINGS)
