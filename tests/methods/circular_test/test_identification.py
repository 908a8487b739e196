"""The parameters and figures of circular tests, and their uncertainties, against truth."""

import numpy as np
import pytest
from coded import raises
from scipy import stats

from errormotion import plugins
from errormotion.campaign.files import load_campaign
from errormotion.errors import MethodError, PluginWarning
from errormotion.measurement.drawing import simulate
from errormotion.methods.circular_test import CircularTest, CircularTestSettings, figures, path
from errormotion.methods.circular_test.path import PARAMETERS, TYPICAL

SMALL = CircularTestSettings(samples=540, places=60)
SEEDS = 150
FALSE_ALARM = 1e-3
R, V = 0.15, 1 / 60
NAMES = figures.NAMES


class Machine(CircularTest):
    """The method, with a machine of other errors for simulated data."""

    def __init__(self, **errors):
        self.errors = errors

    def expected(self, settings):
        return path.expected(settings, self.errors)

    def measured(self, settings, seed):
        """Return raw data."""
        return simulate(self, settings, seed, self.info)[0]

    def path(self, settings):
        """Return the true radial deviation of the path, (2, 7200), m."""
        angle = np.array([path.middles(7200)] * 2)
        sense = np.broadcast_to(path.SENSE[:, None], angle.shape)
        place = path.position(self.errors, angle, sense, settings)
        return np.linalg.norm(place, axis=-1) - settings.nominal_radius


def drawn(seed):
    """Return a machine with random errors of typical size."""
    rng = np.random.default_rng([seed, 7])
    return Machine(**{name: size * rng.standard_normal() for name, size in TYPICAL.items()})


ONE_ERROR = {
    "squareness": (40e-6, 40e-6 * R, 0.0),
    "scale_mismatch": (40e-6, 40e-6 * R, 0.0),
    "servo_mismatch": (0.4e-3, 0.4e-3 * V, 0.4e-3 * V),
    "backlash_1": (4e-6, None, 4e-6),
    "backlash_2": (4e-6, None, 4e-6),
    "bow_1": (3e-6, 1.5e-6, 0.0),
    "bow_2": (3e-6, 1.5e-6, 0.0),
    "spike_1": (5e-6, None, None),
    "spike_2": (5e-6, None, None),
}


@pytest.mark.parametrize("name", PARAMETERS)
def test_each_error_is_found_and_makes_the_deviation_of_its_formula(name):
    """G and H of one error agree with its formula within 1 %, for the average of a sector and the second order."""
    size, g, h = ONE_ERROR[name]
    settings = CircularTestSettings(length_noise=1e-12, length_uncertainty=0.0)
    errors = CircularTest().identify(path.expected(settings, {name: size}), settings)
    found = dict(zip(PARAMETERS, errors["parameters"].values, strict=True))
    assert found.pop(name) == pytest.approx(size, rel=1e-3)
    lengths = {"squareness": R, "scale_mismatch": R, "servo_mismatch": V}
    assert max(abs(value) * lengths.get(other, 1.0) for other, value in found.items()) < 2e-9
    of = dict(zip(NAMES, errors["figures"].values, strict=True))
    if g is not None:
        assert of["G(CCW)"] == pytest.approx(g, rel=0.01)
    if h is not None:
        assert of["H"] == pytest.approx(h, rel=0.01, abs=2e-9)


@pytest.fixture(scope="module")
def ratios():
    """Return the errors of parameters and figures by their standard uncertainty, (seed, n) each."""
    found = {"parameters": [], "figures": []}
    for seed in range(SEEDS):
        machine = drawn(seed)
        errors = CircularTest().identify(machine.measured(SMALL, seed), SMALL)
        true = {
            "parameters": [machine.errors[name] for name in PARAMETERS],
            "figures": figures.evaluate(machine.path(SMALL)),
        }
        for name, C in (("parameters", "parameter_covariance"), ("figures", "figure_covariance")):
            found[name].append((errors[name].values - true[name]) / np.sqrt(np.diagonal(errors[C].values)))
    return {name: np.array(values) for name, values in found.items()}


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_intervals_of_the_parameters_hold_the_truth(ratios):
    held = (np.abs(ratios["parameters"]) <= 1.96).sum(axis=0)
    low, high = stats.binom.ppf([FALSE_ALARM / 20, 1 - FALSE_ALARM / 20], SEEDS, 0.95)
    assert dict(zip(PARAMETERS, (held >= low) & (held <= high), strict=True)) == dict.fromkeys(PARAMETERS, True)
    # Half of all squares, so that a covariance that is too large by a third is also detected.
    assert 0.8 < np.mean(ratios["parameters"] ** 2) < 1.2


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_intervals_of_the_figures_hold_the_truth(ratios):
    """Extreme values are not normal variables; two standard uncertainties contain the truth in 95 % of tests."""
    held = (np.abs(ratios["figures"]) <= 2).sum(axis=0)
    low = stats.binom.ppf(FALSE_ALARM / 7, SEEDS, 0.95)
    assert dict(zip(NAMES, held >= low, strict=True)) == dict.fromkeys(NAMES, True)
    # The uncertainty is not much too large.
    assert (np.mean(ratios["figures"] ** 2, axis=0) > 0.4).all()


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("decay", [1.0, 3.0])
def test_a_spike_is_not_reduced_by_the_width_of_a_sector(decay):
    """G, H and F of the path itself: the mean over 2 degrees of a spike of 3 degrees is a quarter smaller."""
    settings = CircularTestSettings()
    machine = Machine(spike_1=6e-6, spike_2=4e-6, backlash_1=1e-6, backlash_2=1e-6)
    narrow = settings.model_copy(update={"spike_decay": np.radians(decay)})
    true, held, seeds = figures.evaluate(machine.path(narrow)), np.zeros(7), 40
    for seed in range(seeds):
        found = CircularTest().identify(machine.measured(narrow, seed), settings)
        u = np.sqrt(np.diagonal(found["figure_covariance"].values))
        held += np.abs(found["figures"].values - true) <= 2 * u
    low = stats.binom.ppf(FALSE_ALARM / 7, seeds, 0.95)
    assert dict(zip(NAMES, held >= low, strict=True)) == dict.fromkeys(NAMES, True)


@pytest.mark.parametrize(("shape", "size"), [("flat", 0.0), ("ellipse", 20.0), ("spikes", 20.0)])
def test_noise_does_not_make_the_figures_larger(shape, size):
    """The range of noisy values is too large by several standard deviations; the stated figure is not."""
    places, rng = 180, np.random.default_rng(5)
    angle = np.arange(places) * 2 * np.pi / places
    form = {"flat": 0 * angle, "ellipse": np.cos(2 * angle) / 2, "spikes": (np.arange(places) % 45 == 0) * 1.0}[shape]
    true = figures.evaluate(np.array([size * form] * 2))
    plain, stated, u = [], [], []
    for _ in range(40):
        noisy = size * form + rng.standard_normal((2, places))
        found = figures.of_path(noisy, np.ones((2, places)), np.zeros((0, 2, places)))
        plain.append(figures.evaluate(noisy) - true)
        stated.append(found.value - true)
        u.append(np.sqrt(np.diagonal(found.covariance)))
    for name in ("G(CCW)", "G(CW)", "G(b)"):
        k = NAMES.index(name)
        assert np.mean(plain, axis=0)[k] > 3
        assert abs(np.mean(stated, axis=0)[k]) < 1
        assert np.mean(np.abs(np.array(stated)[:, k]) <= 2 * np.array(u)[:, k]) > 0.85


def test_the_plan_is_at_the_bound_of_cramer_and_rao():
    """Averaging by sectors costs 1 %, and 10 % for the spikes, which decay within two sectors.

    The bound is that of all readings for the parameters in addition to radius, offset and drift.
    """
    settings = CircularTestSettings()
    raw, planned = path.expected(settings), CircularTest().plan(settings)
    angle = raw["angle"].values.ravel()
    sense = np.repeat([1.0, -1.0], angle.size // 2)
    basis = path.basis(angle, sense, settings.nominal_radius, settings.feed, settings.spike_decay)
    design = np.hstack([basis, path.circle(angle), raw["reading_time"].values.reshape(-1, 1)])
    scale = np.linalg.norm(design, axis=0)
    bound = np.diagonal(np.linalg.inv((design / scale).T @ (design / scale)))[: len(PARAMETERS)]
    bound = settings.length_noise * np.sqrt(bound) / scale[: len(PARAMETERS)]
    ratio = np.sqrt(np.diagonal(planned["parameter_covariance"].values)) / bound
    assert (ratio > 0.999).all(), ratio
    assert (ratio < [1.1 if "spike" in name else 1.01 for name in PARAMETERS]).all(), ratio
    assert "G(b)" in planned.attrs["notes"][0]
    assert not planned["figures"].values.any()


@pytest.mark.parametrize(
    ("name", "group", "size"),
    [
        ("expansion", "expansion coefficient of the bar", 1e-6),
        ("temperature", "temperature of the bar", 0.05),
        ("length", "calibration of the bar", 0.5e-6),
    ],
)
def test_the_effect_of_a_source_is_the_change_of_the_result(name, group, size):
    """An expansion coefficient that is wrong looks like a drift of a bar that warms up, as far as circles repeat."""
    raw = path.expected(SMALL)
    first, moved = (CircularTest().identify(each, SMALL) for each in (raw, raw.assign({name: raw[name] + size})))
    stated = first["deviation_influence"].values[first["source_group"].values.tolist().index(group)]
    change = (moved["deviation"] - first["deviation"]).values
    # The model of the path changes with the lengths, by less than a thousandth of the effect.
    assert change == pytest.approx(stated, abs=1e-3 * np.abs(stated).max())
    effect = first["figure_influence"].values[first["source_group"].values.tolist().index(group), NAMES.index("D")]
    assert float((moved["figures"] - first["figures"]).sel(figure="D")) == pytest.approx(effect, rel=0.02)


def test_a_path_beyond_the_model_enlarges_the_uncertainty_of_its_parameters():
    machine = Machine(squareness=20e-6, lobes=1e-6)
    errors = CircularTest().identify(machine.measured(SMALL, 2), SMALL)
    assert any("errors beyond the model" in note for note in errors.attrs["notes"])
    u = np.sqrt(np.diagonal(errors["parameter_covariance"].values))
    true = [machine.errors.get(name, 0.0) for name in PARAMETERS]
    assert (np.abs(errors["parameters"].values - true) < 4 * u).all()
    assert float(errors["misfit"]) > 10


@pytest.mark.parametrize(("noise", "size"), [("auto", 1e-6), ("stated", 0.2e-6)])
def test_more_scatter_than_stated_is_reported_and_used_unless_refused(noise, size):
    settings = SMALL.model_copy(update={"length_noise": 1e-6, "noise": noise})
    raw = CircularTest().simulate(settings, 3)[0]
    raw["length_noise"] = raw["length_noise"].copy(data=0.2e-6)
    errors = CircularTest().identify(raw, settings)
    assert float(errors["reading_noise"]) == pytest.approx(size, rel=0.15)
    assert any("catter" in note for note in errors.attrs["notes"])
    assert ("doubts_uncertainty" in errors.attrs) == (noise == "stated")


def test_one_circle_in_each_direction_leaves_the_drift_open():
    settings = SMALL.model_copy(update={"runs": 1})
    errors = CircularTest().identify(CircularTest().simulate(settings, 4)[0], settings)
    assert np.isnan(float(errors["drift"]))
    assert "A drift of the bar is not determined" in errors.attrs["notes"][0]


def test_the_drift_of_the_bar_is_found():
    errors = CircularTest().identify(CircularTest().simulate(SMALL, 4)[0], SMALL)
    warming = path.EXPANSION * R * path.WARMING  # corrected by the temperatures of the circles
    assert float(errors["drift"]) == pytest.approx(path.DRIFT, abs=4 * float(errors["drift_u"]) + 0.2 * warming)


def test_arcs_are_refused():
    raw = CircularTest().simulate(SMALL, 5)[0]
    raw["length"] = raw["length"].where(np.mod(raw["angle"], 2 * np.pi) < 4)
    with raises("circle.gap.too_large"):
        CircularTest().identify(raw, SMALL)


def test_directions_and_axes_have_their_names():
    raw = path.expected(SMALL)
    with pytest.raises(MethodError, match="expected the labels CCW and CW; found left, right"):
        CircularTest().identify(raw.assign_coords(direction_of_travel=["left", "right"]))
    with pytest.raises(MethodError, match="in the order X Y, Y Z or Z X; found Y X"):
        CircularTest().identify(raw.assign_coords(axis=["Y", "X"]))


def test_the_former_name_is_that_of_this_method():
    plugins.refresh()
    old = path.expected(SMALL).assign_attrs(schema="errormotion.raw.ballbar/1")
    with pytest.warns(PluginWarning, match="The method 'ballbar' is called 'circular_test' now"):
        assert plugins.owner_of_schema(old.attrs["schema"]) is CircularTest
    assert plugins.owner_of_method("ballbar") is plugins.get("methods", "ballbar") is CircularTest
    found, now = CircularTest().identify(old, SMALL), CircularTest().identify(path.expected(SMALL), SMALL)
    np.testing.assert_array_equal(found["deviation"], now["deviation"])
    assert [each.name for each in CircularTest.figures(found.assign_attrs(method="ballbar"))] == [
        f"{n} XY" for n in NAMES
    ]


def test_a_campaign_that_names_the_former_method_is_planned(tmp_path):
    (tmp_path / "bench.toml").write_text('schema = "errormotion.bench/1"\nname = "Circular tests"\nmachine = "mc 7"\n')
    (tmp_path / "campaign.toml").write_text(
        'schema = "errormotion.campaign/1"\nname = "Circular test"\nbench = "bench.toml"\n\n'
        '[[test]]\nname = "circle-XY"\nmethod = "ballbar"\nsettings = {nominal_radius = "150 mm", places = 60}\n'
    )
    plugins.refresh()
    with pytest.warns(PluginWarning, match="The method 'ballbar' is called 'circular_test' now"):
        (test,) = load_campaign(tmp_path / "campaign.toml").tests
    assert test.method is CircularTest
    # 2 x 0.5 um of the bar, and little else
    assert 1.0 < 2e6 * float(np.sqrt(CircularTest().plan(test.settings)["deviation_variance"].mean())) < 1.5


def correlated(raw, seed, phi=0.8, size=0.4e-6):
    """Return raw data with further noise, correlated along each circle."""
    e = np.random.default_rng([seed, 5]).standard_normal(raw["length"].shape)
    along = np.moveaxis(e, raw["length"].dims.index("sample"), 0)
    for k in range(1, len(along)):
        along[k] = phi * along[k - 1] + np.sqrt(1 - phi**2) * along[k]
    return raw.assign(length=raw["length"] + size * e)


def test_correlated_noise_of_neighbours_is_noted_and_part_of_the_uncertainty():
    machine = Machine()
    for seed in range(3):
        raw = machine.measured(SMALL, seed)
        plain, found = (machine.identify(each, SMALL) for each in (raw, correlated(raw, seed)))
        assert not any("correlated" in note for note in plain.em.notes)
        assert any("neighbouring lengths is correlated (0." in note for note in found.em.notes)
        # total noise 0.45 um; the scatter within a sector alone would be 0.34 um
        assert 0.38e-6 < float(found["reading_noise"]) < 0.55e-6
        # 18 readings of a sector with a correlation of 0.6 are worth about 6 independent ones; neighbours add some
        white = float(found["reading_noise"]) / np.sqrt(found["reading_count"].values.mean())
        assert float(found["noise_u"].mean()) > 1.3 * white


def test_figures_of_spikes_that_few_readings_see_are_not_too_small():
    z = []
    for seed in range(12):
        raw, truth = CircularTest().simulate(SMALL, seed)
        found = CircularTest().identify(raw, SMALL)
        z.append((found["figures"] - truth["figures"]).values / np.sqrt(np.diagonal(found["figure_covariance"].values)))
    # the mean of 12 has a standard deviation of 0.3; an averaged spike made G smaller by 1.4 u
    assert np.abs(np.mean(z, axis=0)[:4]).max() < 0.9


def test_less_scatter_than_stated_is_reported():
    raw = CircularTest().simulate(SMALL, 3)[0]
    raw["length_noise"] = 3 * raw["length_noise"]
    (note,) = CircularTest().identify(raw, SMALL).em.notes
    assert "less than the stated 0.6 um, which is used" in note
