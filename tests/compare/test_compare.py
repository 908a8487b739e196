"""Complete comparisons: methods that agree, simulated errors and their causes, invalid input, the result."""

import re
import tracemalloc

import numpy as np
import pytest
from coded import raises
from scipy.stats import chi2, kstest, ncx2

from errormotion import datasets
from errormotion.compare import compare
from errormotion.compare.text import cause_text
from errormotion.errors import DatasetError

START = "2026-03-01T08:00:00+00:00"
NOISE = np.array([1e-7] * 3 + [5e-7] * 3)
SIZE = np.array([20e-6, 25e-6, 40e-6, 60e-6, 50e-6, 40e-6])
TAU = np.array([1500.0, 2600.0, 2000.0, 1800.0, 2400.0, 3000.0])


def drift(t):
    """Return a warm-up of all six freedoms, (n, 6), at the functional point 0."""
    t = np.asarray(t)[:, None]
    return SIZE * (1 - np.exp(-t / TAU)) + 0.2 * SIZE * np.sin(t / 1700)


def made(t, rng, *, name="a", change=lambda values: values, point=(0, 0, 0), start=START, radius="", unit=1.0, **more):
    """Return an error dataset of the warm-up with noise and one fully correlated source (a radius).

    ``unit`` is a wrong unit of the rotations, which their uncertainties have as well.
    """
    z = rng.normal()
    F = np.zeros((1, len(t), 6))
    F[0, :, :3] = 0.004 * drift(t)[:, :3]
    values = drift(t) - drift([t[0]])[0] + F[0] * z + NOISE * rng.normal(size=(len(t), 6))
    factor = np.array([1, 1, 1, unit, unit, unit])
    values, F, noise = change(values) * factor, F * factor, NOISE * factor
    ds = datasets.build_errors(
        values,
        np.diag(noise**2) + np.einsum("sti,stj->tij", F, F),
        dims=("time",),
        coords={"time": np.asarray(t, dtype=float)},
        influence=F,
        sources=["radius"],
        source_groups=["radius"],
        source_ids={"radius": radius} if radius else None,
        start=start,
        **{
            "component": "spindle",
            "machine": "C-frame",
            "frame": "machine",
            "functional_point": (0, 0, 0),
            "reference": "cold",
            "method": name,
            "method_version": "1",
            "provenance": {},
        }
        | more,
    )
    return ds.em.at(point).assign_attrs(functional_point=np.array(point, dtype=float)) if any(point) else ds


T1, T2 = np.arange(0, 7201, 60.0), np.arange(0, 7201, 240.0)


def two(rng, **changed):
    return {"drift": made(T1, rng), "probing": made(T2, rng, name="b", component="tool", **changed)}


def test_methods_that_agree_pass_every_test():
    rng, p, en, fit = np.random.default_rng(1), [], [], []
    for _ in range(40):
        found = compare(two(rng), causes=False)
        p.append(found["p"].item())
        en.append(np.nanmean(np.abs(found["en"].values) <= 1))
        fit.append(found.attrs["fit_p"])
    assert 0.92 <= np.mean(en) <= 0.98
    assert 0.3 < np.mean(p) < 0.7
    assert (np.array(p) < 0.01).sum() <= 2
    np.testing.assert_allclose(p, fit, rtol=1e-3)  # of two datasets both are the same test


def test_the_result_is_a_dataset_that_is_saved_and_loaded(tmp_path):
    found = compare(two(np.random.default_rng(2)))
    path = datasets.save(found, tmp_path / "comparison.nc")
    again = datasets.load(path)
    datasets.validate(again)
    assert again["value"].dims == ("dataset", "time", "dof")
    assert again["pair"].values.tolist() == ["drift - probing"]
    assert again.sizes["time"] == T2.size
    assert np.isnan(again["en"].values[0, 0]).all()  # the common reference
    with pytest.raises(DatasetError, match="p: expected probabilities"):
        datasets.validate(again.assign(p=("pair", [2.0])))
    with pytest.raises(DatasetError, match="consensus: missing"):
        datasets.validate(again.drop_vars("consensus"))


def test_datasets_that_start_later_are_compared_from_a_common_state():
    rng = np.random.default_rng(3)
    late = made(T2[5:], rng, name="b", start="2026-03-01T08:00:00+00:00")
    late = late.assign_coords(time=("time", T2[5:] - 600.0, late["time"].attrs)).assign_attrs(
        start="2026-03-01T09:10:00+01:00"
    )
    found = compare({"drift": made(T1, rng), "late": late})
    assert found["time"].values[0] == 1200.0
    assert found.attrs["since"] == 1200.0
    assert found["p"].item() > 0.001


def test_one_bar_in_both_datasets_is_fully_correlated():
    rng = np.random.default_rng(4)
    shared = {"a": made(T1, rng, radius="bar 7"), "b": made(T2, rng, name="b", radius="bar 7")}
    apart = {"a": made(T1, rng), "b": made(T2, rng, name="b")}
    one, both = (compare(each, causes=False)["difference_covariance"].values[0, -1, 0, 0] for each in (shared, apart))
    effect = 0.004 * (drift(T2) - drift([0.0]))[-1, 0]
    assert both - one == pytest.approx(2 * effect**2, rel=0.02)
    assert compare(shared, causes=False).attrs["shared_sources"] == '["bar 7"]'


def flipped(k):
    def change(values):
        values = values.copy()
        values[:, k] *= -1
        return values

    return change


def exchanged(values):
    return values[:, [1, 0, 2, 3, 4, 5]]


def stepped(values):
    values = values.copy()
    values[15:, 0] += 5e-6
    values[15:, 2] -= 8e-6
    return values


PLANTED = {
    "functional point": {"functional_point": (0.0, 0.0, 0.03)},
    "yaw of the frame (about Z)": {"change": lambda v: np.hstack([v[:, :3] @ turn(0.05).T, v[:, 3:] @ turn(0.05).T])},
    "sign of EB": {"change": flipped(4)},
    "EX and EY exchanged": {"change": exchanged},
    "scale of the displacements": {"change": lambda v: v * [1.06, 1.06, 1.06, 1, 1, 1]},
    "shift in time": {"start": "2026-03-01T08:03:00+00:00"},
    "unit of 'probing': urad taken as arcsec": {"unit": 4.8481368},
    "step at 3600 s (something moved)": {"change": stepped},
}


def turn(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize("name", PLANTED)
def test_a_simulated_error_is_detected_and_named(name):
    rng = np.random.default_rng(5)
    for _ in range(3):
        found = compare(two(rng, **PLANTED[name]))
        assert found["p"].item() < 0.001
        assert name in (found["cause"].values[0, 0], *found["alike"].values[0, 0].split("; "))


@pytest.mark.slow
def test_the_size_of_a_mistake_is_estimated_with_its_uncertainty():
    rng = np.random.default_rng(6)
    scores = []
    for _ in range(15):
        found = compare(two(rng, functional_point=(0.0, 0.0, 0.03)))
        size = {
            str(n): (v, u)
            for n, v, u in zip(*(found[k].values[0, 0] for k in ("size_name", "size", "size_u")), strict=True)
        }
        value, u = size["Z (m)"]
        scores.append((abs(value) - 0.03) / u)
    assert 0.01 < chi2.sf(np.square(scores).sum(), 15) < 0.99


def test_a_difference_without_known_cause_is_reported():
    rng = np.random.default_rng(7)

    def noisy(values):
        return values + 8e-7 * np.random.default_rng(1).normal(size=values.shape)

    found = compare(two(rng, change=noisy))
    assert found["p"].item() < 1e-6
    assert found["cause_p"].values[0, 0] < 1e-3


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"machine": "gantry"}, "different attributes 'machine' .*'drift': C-frame; 'probing': gantry"),
        ({"component": "X"}, "different attributes 'component'.*kinematic chain"),
        ({"frame": "table"}, "different attributes 'frame'.*in_frame"),
        ({"start": ""}, "'probing': no attribute 'start'"),
        ({"start": "2026-03-02T08:00:00+00:00"}, "do not overlap in time"),
        ({"change": lambda v: v * np.nan}, "do not overlap in time|no freedom in common"),
    ],
)
def test_incomparable_datasets_are_reported(changed, message):
    if changed.get("component") == "X":
        rng = np.random.default_rng(8)
        pair = {"drift": made(T1, rng), "probing": made(T2, rng, component="X")}
    else:
        pair = two(np.random.default_rng(8), **changed)
    with pytest.raises(DatasetError, match=message):
        compare(pair)


def test_one_dataset_twice_one_alone_and_other_dims_are_refused():
    rng = np.random.default_rng(9)
    ds = made(T1, rng)
    with raises("compare.dataset.same"):
        compare({"a": ds, "b": ds.copy()})
    with raises("compare.datasets.too_few"):
        compare({"a": ds})
    single = ds.em.mean("time")
    with raises("compare.dims.differ"):
        compare({"a": ds, "b": single})
    assert compare({"a": ds, "b": made(T2, rng, start="", name="b")}, same_start=True)["p"].item() > 1e-4


def test_an_unknown_frame_is_refused_and_an_unknown_machine_is_noted():
    rng = np.random.default_rng(9)
    with raises("compare.frame.unknown"):
        compare({name: made(T2, rng, name=name, frame="unknown") for name in "ab"})
    found = compare({name: made(T2, rng, name=name, machine="unknown") for name in "ab"}, causes=False)
    assert any("No dataset states its machine" in note for note in found.attrs["notes"])


def test_a_dataset_without_any_uncertainty_is_refused():
    rng = np.random.default_rng(9)
    exact = made(T2, rng, name="b")
    exact = exact.assign({name: 0.0 * exact[name] for name in ("covariance", "influence")})
    with raises("compare.covariance.zero"):
        compare({"a": made(T1, rng), "b": exact})


def test_three_datasets_have_a_consensus_and_the_deviating_one_is_named():
    rng = np.random.default_rng(10)
    found = compare({"a": made(T1, rng), "b": made(T2, rng), "c": made(T2 + 30.0, rng, change=lambda v: v * 1.2)})
    assert found["misfit_p"].idxmin().item() == "c"
    assert found["misfit_p"].values[2] < 1e-6
    assert found.attrs["birge_ratio"] > 2
    assert found.sizes["pair"] == 3


def test_memory_grows_linearly_with_the_times():
    peaks, rng = [], np.random.default_rng(11)
    for size in (2_000, 8_000):
        t = np.linspace(0, 7200, size)
        sets = {"a": made(t, rng), "b": made(t, rng, name="b")}
        tracemalloc.start()
        found = compare(sets, causes=False)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert found.sizes["time"] == size
    assert peaks[1] < 5 * peaks[0]


def test_many_datasets_are_compared_with_one_of_them():
    rng, t = np.random.default_rng(13), np.arange(0, 1801, 600.0)
    sets = {f"m{k}": made(t, rng, name=f"m{k}") for k in range(42)}
    found = compare(sets, causes=False)
    assert found.sizes["pair"] == 41
    assert any("'m0' with each of the others" in note for note in found.attrs["notes"])
    few = {name: sets[name] for name in ("m0", "m1", "m2")}
    assert compare(few, causes=False, against="m2")["pair"].values.tolist() == ["m2 - m0", "m2 - m1"]
    with raises("compare.against.unknown"):
        compare(few, against="m9")


def test_no_two_interpolated_values_depend_on_the_same_measured_one(monkeypatch):
    """With common neighbours the values would be correlated, which the covariance of the result does not include."""
    monkeypatch.setitem(globals(), "NOISE", 10 * NOISE)  # far more than what interpolation adds
    rng, p, between = np.random.default_rng(14), [], T2[:-1] + 120.0
    for _ in range(60):
        found = compare({"a": made(T2, rng), "b": made(between, rng, name="b")}, causes=False)
        p.append(found["p"].item())
    assert found.sizes["time"] == 15
    assert "14 of 29 times are left out" in found.attrs["notes"][0]
    assert kstest(p, "uniform").pvalue > 0.01


class Exact:
    """A generator of zeros: a dataset without noise."""

    def normal(self, *_, size=None):
        return np.zeros(size) if size is not None else 0.0


def test_an_error_is_detected_as_often_as_its_non_centrality_predicts():
    rng, changed = np.random.default_rng(15), {"functional_point": (0.0, 0.0, 0.010)}
    exact = compare(two(Exact(), **changed), causes=False)
    degrees, squares = int(exact["degrees"].item()), exact["chi2"].item()
    predicted = ncx2.sf(chi2.isf(0.05, degrees), degrees, squares)
    assert 0.8 < predicted < 0.97
    found = np.mean([compare(two(rng, **changed), causes=False)["p"].item() < 0.05 for _ in range(25)])
    assert abs(found - predicted) < 3 * np.sqrt(predicted * (1 - predicted) / 25)


def test_causes_with_scores_that_are_close_are_named_together():
    """A wrong unit of one of two datasets is the inverse one of the other."""
    first = compare(two(np.random.default_rng(16), unit=4.8481368)).isel(pair=0, rank=0)
    units = {"unit of 'probing': urad taken as arcsec", "unit of 'drift': arcsec taken as urad"}
    assert units <= {first["cause"].item(), *first["alike"].item().split("; ")}


def test_a_wrong_functional_point_is_named_if_only_displacements_are_compared():
    rng = np.random.default_rng(12)
    wrong = made(T2, rng, name="b").em.at((0, 0, 0.05)).assign_attrs(functional_point=np.zeros(3))
    found = compare({"drift": made(T1, rng), "probing": wrong}, freedoms=["EX", "EY", "EZ"])
    first = found.isel(pair=0, rank=0)
    assert first["cause"].item().startswith("functional point")
    z = first["size_name"].values.tolist().index("Z (m)")
    assert abs(abs(first["size"].values[z]) - 0.05) < 4 * first["size_u"].values[z]
    both = {first["cause"].item(), *first["alike"].item().split("; ")}
    assert both == {"functional point of 'drift'", "functional point of 'probing'"}


def test_sizes_are_printed_in_the_units_of_the_field():
    rng = np.random.default_rng(5)
    step = cause_text(compare(two(rng, change=stepped)), 0, 0)
    assert step.name.startswith("step at 3600 s")
    assert re.search(r"EZ 7\.\d+ ± 0\.\d+ um", step.size)
    point = cause_text(compare(two(rng, functional_point=(0.0, 0.0, 0.03))), 0, 0)
    assert re.search(r"^Z -?[23]\d\.?\d* ± \d\.?\d* mm$", point.size)


def test_datasets_without_any_source_are_compared():
    t, rng = np.arange(0.0, 3000.0, 300.0), np.random.default_rng(6)

    def plain(u):
        values = drift(t) + u * rng.normal(size=(len(t), 6))
        columns = {
            name: ("time", values[:, k], {"units": "m" if k < 3 else "rad"}) for k, name in enumerate(datasets.DOF)
        }
        columns["covariance"] = (("time", "dof", "dof_"), np.tile(np.eye(6) * u**2, (len(t), 1, 1)))
        return made(t, rng).drop_dims("source").assign(columns)

    found = compare({"one": plain(1e-7), "exact": plain(1e-10)})
    assert float(found["p"].min()) > 1e-4
    en = found["en"].values
    assert np.mean(np.abs(en[np.isfinite(en)]) <= 1) > 0.8


def test_a_wrong_functional_point_is_determined_if_some_rotations_are_compared():
    t, rng = np.arange(0.0, 9000.0, 300.0), np.random.default_rng(7)
    moved = made(t, rng, name="moved").em.at([0.0, 0.0, 0.05]).assign_attrs(functional_point=[0.0, 0.0, 0.0])
    found = compare({"moved": moved, "right": made(t, rng)}, freedoms=("EX", "EY", "EZ", "EA"))
    names = [cause.name for rank in range(found.sizes["rank"]) if (cause := cause_text(found, 0, rank)) is not None]
    assert names[0].startswith("functional point of '")


def single(values):
    """Return errors at one position."""
    return datasets.build_errors(
        np.array(values) * 1e-6, np.diag([1e-12] * 6), dims=(), coords={}, component="spindle", machine="M",
        frame="machine", functional_point=(0, 0, 0), reference="cold", method="m", method_version="1", provenance={},
    )  # fmt: skip


def test_a_comparison_is_drawn():
    found = compare(two(np.random.default_rng(2)), causes=False)
    figure = found.em.plot()
    assert len(figure.axes) == 2 * found.sizes["dof"]
    values, en = figure.axes[4], figure.axes[5]  # of EZ
    shown = [line.get_ydata() for line in values.lines if len(line.get_ydata())]
    np.testing.assert_allclose(shown[0], 1e6 * found["value"].values[0, :, 2])
    assert values.get_ylabel() == "EZ / µm"
    drawn = next(line.get_ydata() for line in en.lines if len(line.get_ydata()) == found.sizes["time"])
    np.testing.assert_allclose(drawn, found["en"].values[0, :, 2])
    legends = [axes.get_legend() for axes in figure.axes if axes.get_legend() is not None]
    legend = [text.get_text() for each in legends for text in each.texts]
    assert legend == ["drift", "probing", "drift - probing"]
    with pytest.raises(DatasetError, match=r"'\.em\.at' belongs to error datasets"):
        found.em.at((0, 0, 0))


def test_single_values_are_compared_and_drawn():
    found = compare({"a": single(range(6)), "b": single(range(1, 7)), "c": single([9] * 6)})
    assert found["value"].dims == ("dataset", "dof")
    assert len(found.em.plot().axes) == 12
