import numpy as np
import pytest
import xarray as xr
from xarray.indexes import RangeIndex

from errormotion import datasets
from errormotion.datasets.files.sampling import SAMPLE, sample


def reported(ds: xr.Dataset) -> str:
    return "\n".join(datasets.violations(ds))


class Counting:
    """A simulated array on a disk that counts the values read."""

    def __init__(self, shape: tuple[int, ...], value: float) -> None:
        self.shape, self.ndim, self.dtype = shape, len(shape), np.dtype("f4")
        self.value, self.read = value, 0

    def __array_function__(self, *_):
        return NotImplemented

    def __array_ufunc__(self, *_):
        return NotImplemented

    def __getitem__(self, key):
        # xarray ends its key with an ellipsis
        sizes = [len(range(*part.indices(size))) for part, size in zip(key, self.shape, strict=False)]
        self.read += int(np.prod(sizes))
        return np.full(sizes, self.value, dtype=self.dtype)


def test_valid_datasets_conform_to_their_schema(drift, beams) -> None:
    assert datasets.violations(drift()) == []
    assert datasets.violations(beams()) == []


def test_both_layouts_and_float32_are_accepted(drift) -> None:
    ds = drift()
    assert datasets.violations(ds.assign(distance=ds["distance"].astype("f4").transpose("time", "channel"))) == []


def test_optional_variables_may_be_missing(drift) -> None:
    assert datasets.violations(drift().drop_vars(["beam_covariance", "temperature", "sensor"])) == []


def test_labels_may_be_bytes_and_channels_in_any_order(drift) -> None:
    ds = drift().isel(channel=[4, 1, 2, 3, 0])
    assert datasets.violations(ds.assign_coords(channel=ds["channel"].astype("S2"))) == []


def test_a_missing_channel_is_named(drift, beams) -> None:
    expected = "channel: expected X1 X2 Y1 Y2 Z; found X1 X2 Y1 Z: missing Y2"
    for ds in (drift(), beams()):
        assert datasets.violations(ds.sel(channel=["X1", "X2", "Y1", "Z"])) == [expected]
    assert "missing Y2, unknown Y3" in reported(drift().assign_coords(channel=["X1", "X2", "Y1", "Y3", "Z"]))
    assert "expected a coordinate with the labels X1 X2 Y1 Y2 Z; found none" in reported(drift().drop_vars("channel"))


def test_a_bar_radius_in_mm_is_reported(drift) -> None:
    assert datasets.violations(drift(bar_radius=5.0)) == ["bar_radius = 5 m: expected 0.0005..0.1 m; is it in mm?"]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"distance_noise": 0.3}, "distance_noise = 0.3 m: expected 0..0.001 m; is it in mm?"),
        ({"distance_noise": -1e-6}, "distance_noise = -1e-06 m: expected 0..0.001 m"),
        ({"level": ("height", [10.0, 50.0])}, "level = 50 m: expected -20..20 m; is it in mm?"),
        ({"level": ("height", [0.01, np.nan])}, "level: expected numbers; found NaN"),
        ({"bar_radius": np.nan}, "bar_radius: expected numbers; found NaN"),
        ({"bar_radius": "5 mm"}, "bar_radius: expected numbers (float64); found text"),
        ({"bar_radius": ("channel", [0.005] * 5)}, "bar_radius: expected dims (); found (channel)"),
        (
            {"temperature": (("time", "sensor"), np.full((50, 1), 294.0))},
            "temperature = 294 degC: expected -60..200 degC; is it in K?",
        ),
        ({"distance": (("channel", "time"), np.ones((5, 50)))}, "distance = 1 m: expected -0.1..0.1 m; is it in mm?"),
        ({"distance": (("channel", "time"), np.full((5, 50), np.inf))}, "distance: expected finite numbers"),
        (
            {"beam_direction": (("channel", "direction"), np.full((5, 3), 0.5))},
            "beam_direction: expected unit vectors; found one of length 0.866025. Divide it by its length",
        ),
        (
            {"beam_covariance": (("channel", "p", "p_"), np.tile(np.triu(np.ones((6, 6))), (5, 1, 1)) * 1e-12)},
            "beam_covariance: expected a symmetric matrix; found one that is not",
        ),
        (
            {"beam_covariance": (("channel", "p", "p_"), np.tile(1 - 2 * np.eye(6), (5, 1, 1)) * 1e-12)},
            "beam_covariance: expected no negative variance in any direction; found one",
        ),
    ],
)
def test_an_impossible_value_is_reported_with_the_expected_one(drift, changes, sentence) -> None:
    (found,) = datasets.violations(drift(**changes))
    assert found.startswith(sentence)


def test_all_violations_are_reported_at_once(drift) -> None:
    ds = drift(bar_radius=5.0).drop_vars(["distance_noise", "level"]).sel(channel=["X1", "X2", "Y1", "Y2"])
    ds["distance"].attrs["units"] = "mm"
    with pytest.raises(datasets.validation.DatasetError) as caught:
        datasets.validate(ds)
    assert len(caught.value.violations) == 5
    for part in ("missing Z", "bar_radius", "distance_noise(): missing", "level(height): missing", "found 'mm'"):
        assert part in str(caught.value)


@pytest.mark.parametrize("unit", ["m", "metre", "meter"])
def test_an_equivalent_unit_is_accepted(drift, unit) -> None:
    ds = drift()
    ds["distance"].attrs["units"] = unit
    assert datasets.violations(ds) == []


@pytest.mark.parametrize("unit", ["mm", "s", "nonsense"])
def test_a_different_unit_is_refused(drift, unit) -> None:
    ds = drift()
    ds["distance"].attrs["units"] = unit
    assert f"distance: expected units 'm'; found '{unit}'" in reported(ds)


def test_times_increase_or_follow_from_the_rate(drift) -> None:
    ds = drift()
    t = ds["time"].values.copy()
    t[20] = t[19]
    assert "time: expected increasing seconds; found 9.5 s after 9.5 s" in reported(ds.assign_coords(time=t))
    assert "time(time): missing" in reported(ds.drop_vars("time"))
    assert datasets.violations(ds.drop_vars("time").assign_attrs(sample_rate=20e3)) == []
    assert "'sample_rate': expected a positive number" in reported(ds.drop_vars("time").assign_attrs(sample_rate=0.0))


def test_a_large_record_is_checked_by_samples(drift) -> None:
    n = 288_000_000  # 4 h at 20 kHz: 5.8 GB of float32
    lazy = Counting((5, n), 1e-3)
    times = xr.Coordinates.from_xindex(RangeIndex.linspace(0, n / 20e3, n, endpoint=False, dim="time"))
    ds = drift().drop_dims("time").assign(distance=(("channel", "time"), lazy)).assign_coords(times)
    assert datasets.violations(ds) == []
    assert 0 < lazy.read <= SAMPLE
    assert not ds["time"].variable._in_memory
    lazy.value = 1.0
    assert "distance = 1 m" in reported(ds)


def test_samples_include_the_first_and_the_last_value() -> None:
    values = sample(xr.Variable(("time",), np.arange(1_000_000)))
    assert values[0] == 0
    assert values[-1] == 999_999
    assert SAMPLE / 2 < values.size <= SAMPLE
    assert np.diff(values).max() < 1_000_000 / 15


@pytest.mark.parametrize("raw", datasets.schemas.raw_schemas(), ids=lambda raw: raw.title)
def test_every_schema_accepts_valid_data_and_reports_missing_variables(raw) -> None:
    sizes = {"channel": 5, "height": 2, **raw.sizes}
    variables = {}
    for row in raw.rows:
        shape = [sizes.get(dim, 4) for dim in row.dims]
        values = np.full(shape, max(row.low, 0.0) if np.isfinite(row.low) else 0.0)
        if row.unit == "1" and row.dims[-1:] == ("direction",):
            values = np.broadcast_to([0.0, 0.0, 1.0], shape)
        if row.name == "time":
            values = np.arange(4.0)
        variables[row.name] = (row.dims, values, {"units": row.unit} if row.unit else {})
    ds = xr.Dataset(variables, attrs={"schema": raw.id})
    ds = ds.assign_coords({dim: list(labels) for dim, labels in raw.labels.items()})
    assert datasets.violations(ds) == []
    for row in raw.rows:
        if row.required and row.name != raw.marker:
            assert f"{row.name}({', '.join(row.dims)}): missing" in reported(ds.drop_vars(row.name))
