"""Repeats: variance components, their intervals, the expectation by the stated uncertainties, and the table."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from coded import raises
from typer.testing import CliRunner

from errormotion import datasets
from errormotion.cli.app import app
from errormotion.compare import compare
from errormotion.compare.repeats import KINDS, interval_coverage, labels, repeats
from errormotion.compare.stack import Estimate
from errormotion.errors import DatasetError

Y = np.array([[9.8, 10.4, 10.0], [11.9, 12.3, 12.4], [8.8, 9.6, 9.2]])
"""Three groups of three values."""


def estimates(values, u=1.0, sources=(), points=1):
    return [
        Estimate(str(i), np.full((points, 1), each), np.full((points, 1, 1), u**2),
                 np.array([[[size]] * points for _, size in sources[i] if sources]).reshape(-1, points, 1)
                 if sources else np.zeros((0, points, 1)), tuple(key for key, _ in sources[i]) if sources else ())
        for i, each in enumerate(values)
    ]  # fmt: skip


def test_the_components_are_those_of_the_analysis_of_variance():
    found = repeats(estimates(Y.ravel()), np.repeat(["a", "b", "c"], 3).tolist())
    within = ((Y - Y.mean(axis=1, keepdims=True)) ** 2).sum() / 6
    between = 3 * Y.mean(axis=1).var(ddof=1)
    expected = [within, (between - within) / 3, (between - within) / 3 + within]
    np.testing.assert_allclose(found.value[:, 0] ** 2, expected, rtol=1e-12)
    assert found.degrees[0, 0] == pytest.approx(6)
    assert (found.low[:, 0] < found.value[:, 0]).all()
    assert (found.value[:, 0] < found.high[:, 0]).all()


def test_stated_uncertainty_and_shared_sources_are_respected():
    bars = [[("bar a", 2.0), ("room", 3.0)]] * 3 + [[("bar b", 2.0), ("room", 3.0)]] * 3
    found = repeats(estimates(np.arange(6.0), 0.5, bars), ["a"] * 3 + ["b"] * 3)
    np.testing.assert_allclose(found.stated[:, 0], [0.5, 2.0, np.hypot(0.5, 2.0)])
    assert found.common[0] == pytest.approx(3.0)


def test_without_repeats_in_a_group_only_the_sum_is_known_and_without_groups_only_the_repeatability():
    alone = repeats(estimates([1.0, 2.0, 4.0]), ["a", "b", "c"])
    assert np.isnan(alone.value[:2, 0]).all()
    assert alone.value[2, 0] == pytest.approx(np.std([1.0, 2.0, 4.0], ddof=1))
    one = repeats(estimates([1.0, 2.0, 4.0]), ["a"] * 3)
    assert one.value[0, 0] == pytest.approx(np.std([1.0, 2.0, 4.0], ddof=1))
    assert np.isnan(one.value[1:, 0]).all()
    with raises("repeats.too_few"):
        repeats(estimates([1.0]), ["a"])


@pytest.mark.parametrize(("points", "shared", "most"), [(1, 0.0, 0.985), (10, 0.95, 0.99), (10, 0.3, 1.0)])
def test_the_intervals_contain_the_truth_with_their_probability(points, shared, most):
    found = interval_coverage(4, 4, 400, 2, points=points, shared=shared)
    assert set(found) == set(KINDS)
    for share in found.values():  # 0.95 with a standard deviation of 0.011
        assert 0.915 <= share <= most


def warm_up(rng, between=0.0, start="2026-03-02T07:00:00+00:00", **about):
    """Return a warm-up whose end differs from one operator to the next."""
    t = np.arange(0.0, 3601.0, 300.0)
    values = np.zeros((t.size, 6))
    values[:, 2] = (30e-6 + between) * (1 - np.exp(-t / 1200)) + 1e-6 * rng.normal(size=t.size) * (t > 0)
    values[:, :2] = 1e-6 * rng.normal(size=(t.size, 2))
    values[:, 3:] = np.nan
    instruments = about.pop("instruments", ())
    return datasets.build_errors(
        values, np.tile(np.diag([1e-12] * 3 + [1e-12] * 3), (t.size, 1, 1)), dims=("time",), coords={"time": t},
        component="spindle", machine="M", frame="machine", functional_point=(0, 0, 0), reference="cold",
        method="example", method_version="1", start=start, measured=about,
        provenance={"instruments": [{"identity": {"model": "S", "serial_number": each}} for each in instruments]},
    )  # fmt: skip


@pytest.fixture
def three_operators(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(3)
    names = []
    for k, (operator, off) in enumerate((("Anna", 0.0), ("Ben", 8e-6), ("Cem", -8e-6))):
        for day in range(2):
            start = f"2026-03-{10 * k + day + 1:02}T07:00:00+00:00"
            name = f"{operator}-{day}.nc"
            datasets.save(warm_up(rng, off, start, operator=operator, instruments=(f"{k}",)), name)
            names.append(name)
    return SimpleNamespace(files=names)


def call(*arguments):
    return CliRunner().invoke(app, ["compare", *arguments])


def test_different_operators_are_shown_in_the_table_and_on_the_page(three_operators, tmp_path):
    shown = call(*three_operators.files, "--by", "operator", "--same-start", "--out", "c.nc", "--report", "c.html")
    assert shown.exit_code == 0, shown.output
    found = datasets.load("c.nc")
    datasets.validate(found)
    assert found["group"].values.tolist() == ["Anna"] * 2 + ["Ben"] * 2 + ["Cem"] * 2
    z = found.sel(dof="EZ")
    between = z["spread"].sel(kind="between groups").item()
    assert z["spread_low"].sel(kind="between groups").item() < between
    assert 3e-6 < between < 9e-6
    assert z["spread_p"].sel(kind="between groups").item() < 0.01
    assert found["spread_p"].sel(kind="repeatability").min() > 0.001
    assert "between groups" in shown.stdout
    page = (tmp_path / "c.html").read_text()
    assert "Repeatability and reproducibility" in page
    assert "Anna (Anna-0, Anna-1)" in page
    said = json.loads(call(*three_operators.files, "--by", "instrument", "--same-start", "--json").stdout)
    assert {row["kind"] for row in said["spread"]} == {*KINDS, "shared by all"}
    with pytest.raises(DatasetError, match="spread_low: missing"):
        datasets.validate(found.drop_vars("spread_low"))


def test_repeats_on_other_days_require_the_option_same_start(three_operators):
    result = call(*three_operators.files, "--by", "operator")
    assert result.exit_code == 1
    assert "do not overlap in time" in result.stderr


@pytest.mark.parametrize(
    ("by", "message"), [("operator", "'b': no operator is stated"), ("instrument", "no instrument")]
)
def test_a_dataset_without_group_is_named(by, message):
    rng = np.random.default_rng(4)
    both = {"a": warm_up(rng, operator="Anna"), "b": warm_up(rng)}
    with pytest.raises(DatasetError, match=message):
        labels(both, by)
    assert labels(both, "method") == {"a": "example", "b": "example"}


def test_a_comparison_without_groups_has_none():
    rng = np.random.default_rng(5)
    found: xr.Dataset = compare({"a": warm_up(rng), "b": warm_up(rng)}, causes=False)
    assert "spread" not in found.variables
    assert "kind" not in found.dims
