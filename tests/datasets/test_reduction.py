"""Another reference state, a mean, and data for a comparison: covariances by Monte Carlo, and refused cases."""

import numpy as np
import pytest
from coded import raises

from errormotion import datasets
from errormotion.datasets.timing import between, later
from errormotion.errors import DatasetError

N = 12
T = np.arange(N) * 60.0


def made(values, covariance, influence=None, **more):
    dims = more.pop("dims", ("time",))
    coords = more.pop("coords", {"time": T})
    sources = [f"s{k}" for k in range(0 if influence is None else len(influence))]
    if influence is not None:
        more |= {"influence": influence, "sources": sources, "source_groups": sources}
    return datasets.build_errors(
        values,
        covariance,
        dims=dims,
        coords=coords,
        component="spindle",
        machine="C-frame",
        frame="machine",
        functional_point=(0, 0, 0),
        reference="cold",
        method="example",
        method_version="1",
        provenance={},
        **more,
    )


def model(rng, shape=(N,)):
    """Return the independent covariance (..., 6, 6) and the influence (2, ..., 6) of an error dataset."""
    A = rng.normal(0, 1e-6, (*shape, 6, 6))
    return A @ np.swapaxes(A, -1, -2), rng.normal(0, 2e-6, (2, *shape, 6))


def draw(rng, own, F):
    root = np.linalg.cholesky(own)
    noise = np.einsum("...ij,...j->...i", root, rng.normal(size=own.shape[:-1]))
    return noise + np.einsum("s...i,s->...i", F, rng.normal(size=len(F)))


@pytest.mark.parametrize("interval", [0.0, (0.0, 120.0), 300.0])
@pytest.mark.parametrize("shape", [(N,), (N, 3)])
def test_changes_since_a_state_have_the_covariance_of_the_differences(interval, shape):
    rng = np.random.default_rng(5)
    own, F = model(rng, shape)
    total = own + np.einsum("s...i,s...j->...ij", F, F)
    more = (
        {} if len(shape) == 1 else {"dims": ("time", "position"), "coords": {"time": T, "y": ("position", [0, 1, 2])}}
    )
    ds = made(np.zeros((*shape, 6)), total, F, **more)
    first, last = (interval, interval) if isinstance(interval, float) else interval
    inside = (first <= T) & (last >= T)
    found = ds.em.since(interval)
    drawn = np.array([draw(rng, own, F) for _ in range(4000)])
    change = drawn - drawn[:, inside].mean(axis=1, keepdims=True)
    near = np.std(change, axis=0)
    u = np.sqrt(np.diagonal(found["covariance"].values, axis1=-2, axis2=-1))
    outside = ~inside
    assert np.abs(u[outside] / near[outside] - 1).max() < 0.06
    if inside.sum() == 1:
        assert (found["covariance"].values[inside] == 0).all()
    else:  # rows within the interval: the noise of the others is neglected where it differs from their own
        assert (u[inside] / near[inside]).mean() == pytest.approx(1, abs=0.1)
    between_rows = [4, 7] if first == 0 else [1, 9]
    i, j = ((row, *([1] * (len(shape) - 1))) for row in between_rows)
    sample = np.einsum("ra,rb->ab", change[(slice(None), *i)], change[(slice(None), *j)]) / len(change)
    expected = found.em.covariance_between(i, j).values
    assert np.abs(sample - expected).max() < 0.08 * np.abs(near).max() ** 2
    assert datasets.violations(found) == []


def test_a_state_twice_is_not_counted_twice():
    rng = np.random.default_rng(1)
    own, F = model(rng)
    ds = made(rng.normal(0, 1e-6, (N, 6)), own + np.einsum("s...i,s...j->...ij", F, F), F)
    once, twice = ds.em.since(60.0), ds.em.since(0.0).em.since(60.0)
    np.testing.assert_allclose(twice.em.twist().values, once.em.twist().values, atol=1e-18)
    far = slice(2, None)
    np.testing.assert_allclose(twice["covariance"].values[far], once["covariance"].values[far], rtol=1e-6, atol=1e-20)


def test_time_and_start_count_from_the_new_state(tmp_path):
    own = np.tile(np.eye(6) * 1e-14, (N, 1, 1))
    ds = made(np.zeros((N, 6)), own, start="2026-03-01T09:00:00+01:00", notes=["one"], reference_interval=(0, 0))
    datasets.save(ds, tmp_path / "a.nc")
    ds = datasets.load(tmp_path / "a.nc")
    assert ds.attrs["notes"] == ["one"]
    assert ds.em.notes == ["one"]
    found = ds.em.since(120.0)
    assert found.attrs["start"] == "2026-03-01T08:02:00+00:00"
    assert found["time"].values[2] == 0
    assert found["time"].attrs["units"] == "s"
    assert list(found.attrs["reference_interval"]) == [0, 0]
    assert found["source_reference"].values.tolist() == [1] * 6


def test_undetermined_freedoms_are_unknown_and_a_state_without_values_is_refused():
    values = np.zeros((N, 6))
    values[:, 5] = np.nan
    values[3] = np.nan
    ds = made(values, np.tile(np.eye(6) * 1e-14, (N, 1, 1)))
    found = ds.em.since(0.0)
    assert np.isnan(found["EC"].values).all()
    assert np.isnan(found["EX"].values).sum() == 1
    with pytest.raises(DatasetError, match="No known errors from 180 s to 180 s"):
        ds.em.since(180.0)
    with pytest.raises(DatasetError, match="Expected errors over 'position'; found time"):
        ds.em.mean("position")


def test_a_mean_has_its_covariance():
    rng = np.random.default_rng(2)
    own, F = model(rng)
    values = rng.normal(0, 1e-6, (N, 6))
    values[5] = np.nan
    ds = made(values, own + np.einsum("s...i,s...j->...ij", F, F), F)
    found = ds.em.mean("time")
    known = ~np.isnan(values[:, 0])
    drawn = np.array([draw(rng, own, F)[known].mean(axis=0) for _ in range(4000)])
    assert found["EX"].item() == pytest.approx(values[known, 0].mean())
    u = np.sqrt(np.diag(found["covariance"].values))
    assert np.abs(u / drawn.std(axis=0) - 1).max() < 0.06
    assert datasets.violations(found) == []


@pytest.mark.parametrize("change", [lambda ds: ds.mean("time"), lambda ds: ds.interp(time=T[:-1] + 20.0)])
def test_the_effect_of_plain_xarray_on_a_covariance_is_reported(change):
    ds = made(np.zeros((N, 6)), np.tile(np.eye(6) * 1e-14, (N, 1, 1)))
    changed = change(ds).assign_attrs(ds.attrs)
    assert any("time_index" in each and "ds.em" in each for each in datasets.violations(changed))
    assert datasets.violations(ds.isel(time=slice(2, 9, 3))) == []
    assert datasets.violations(ds.isel(time=3)) == []


@pytest.mark.parametrize(
    ("attrs", "message"),
    [
        ({"start": "2026-03-01T09:00:00"}, "'start': expected instant of time 0"),
        ({"start": "today"}, "'start'"),
        ({"reference_interval": [1.0]}, "'reference_interval'"),
        ({"reference_interval": [2.0, 1.0]}, "'reference_interval'"),
        ({"reference_position": "left"}, "'reference_position'"),
    ],
)
def test_attributes_of_a_comparison_are_checked(attrs, message):
    ds = made(np.zeros((N, 6)), np.tile(np.eye(6) * 1e-14, (N, 1, 1))).assign_attrs(attrs)
    assert any(message in each for each in datasets.violations(ds))


def test_identities_of_sources_are_checked():
    F = np.full((2, N, 6), 1e-8)
    C = np.tile(np.eye(6) * 1e-14, (N, 1, 1))
    ds = made(np.zeros((N, 6)), C, F, source_ids={"s1": "certificate 7"}, reference_sources=["s0"])
    assert ds["source_id"].values.tolist() == ["", "certificate 7"]
    assert ds["source_reference"].values.tolist() == [1, 0]
    with raises("errors.sources.unknown"):
        made(np.zeros((N, 6)), C, F, source_ids={"s9": "x"})
    twice = ds.assign_coords(source_id=("source", ["a", "a"]))
    assert any("source_id: expected texts that differ" in each for each in datasets.violations(twice))


def test_instants():
    assert later("2026-03-01T09:00:00+01:00", 1.5) == "2026-03-01T08:00:01.500000+00:00"
    assert later("", 1.0) == ""
    assert between("2026-03-01T09:00:00+01:00", "2026-03-01T08:00:10+00:00") == 10
    with raises("time.start.form"):
        later("2026-03-01T09:00:00", 0.0)
