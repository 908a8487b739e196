import numpy as np
import pytest
import xarray as xr

from errormotion import datasets
from errormotion.datasets import DOF, SCHEMA
from errormotion.errors import DatasetError


def violations(ds: xr.Dataset) -> str:
    with pytest.raises(DatasetError) as caught:
        datasets.validate(ds)
    assert caught.value.violations == datasets.violations(ds)
    return "\n".join(caught.value.violations)


def test_a_result_has_the_schema_its_units_and_its_attributes(errors) -> None:
    ds = errors()
    assert datasets.violations(ds) == []
    assert ds.attrs["schema"] == SCHEMA
    assert ds.attrs["sign"] == "actual minus commanded, tool side relative to workpiece side"
    assert [ds[name].attrs["units"] for name in DOF] == ["m"] * 3 + ["rad"] * 3
    assert ds["covariance"].dims == ("time", "dof", "dof_")
    assert ds["influence"].dims == ("source", "time", "dof")
    assert list(ds["source_group"].values) == ["beams", "beams", "reference"]
    assert ds["time"].attrs["units"] == "s"
    assert "temperature" in ds.coords


def test_one_point_needs_no_dimension(errors) -> None:
    ds = errors(values=np.zeros(6), covariance=np.eye(6) * 1e-12, dims=(), coords={}, influence=None)
    assert ds["EX"].dims == ()
    assert datasets.violations(ds) == []


def test_an_undetermined_freedom_is_nan_in_covariance_and_influence(errors) -> None:
    ds = errors(unseen=(5,))
    assert np.isnan(ds["covariance"].sel(dof="EC")).all()
    assert np.isnan(ds["covariance"].sel(dof_="EC")).all()
    assert np.isnan(ds["influence"].sel(dof="EC")).all()
    assert np.isfinite(ds["covariance"].sel(dof=list(DOF[:5]), dof_=list(DOF[:5]))).all()


def test_a_value_may_be_unknown_at_single_times(errors) -> None:
    values = np.zeros((7, 6))
    values[2, 1] = np.nan
    ds = errors(values=values)
    assert int(np.isnan(ds["covariance"]).sum()) == 11  # one row and one column of one matrix


def test_extra_results_are_stored_except_with_a_name_of_the_schema(errors) -> None:
    ds = errors(extras={"bar_radius": xr.DataArray(0.005, attrs={"units": "m"})})
    assert ds["bar_radius"].attrs["units"] == "m"
    with pytest.raises(DatasetError, match="not used by the schema; found EX"):
        errors(extras={"EX": xr.DataArray(0.0)})


def test_all_violations_of_a_result_are_reported_at_once(errors) -> None:
    values = np.zeros((7, 6))
    values[0, 0] = 0.3
    values[1, 3] = 0.5
    with pytest.raises(DatasetError) as caught:
        errors(values=values, component="saddle", reference=" ", functional_point=(0, 0, 500))
    message = "\n".join(caught.value.violations)
    assert len(caught.value.violations) == 5
    assert "EX = 0.3 m: expected -0.1..0.1 m; is it in mm?" in message
    assert "EA = 0.5 rad: expected -0.2..0.2 rad" in message
    assert "component" in message
    assert "reference" in message
    assert "500 m: expected within 50 m; is it in mm?" in message


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"values": np.zeros((7, 5))}, r"values: expected shape \(time, 6\); found \(7, 5\)"),
        ({"covariance": np.zeros((7, 6))}, r"covariance: expected shape \(7, 6, 6\); found \(7, 6\)"),
        ({"influence": np.zeros((2, 7, 6))}, r"influence: expected shape \(3, 7, 6\)"),
        ({"source_groups": ["beams"]}, "source_groups: expected 3"),
        ({"coords": {"time": np.arange(5.0)}}, "do not fit together"),
        (
            {"dims": ("cycle",), "coords": {}},
            "expected dims from time, position, target, beam, or declared by .*; found cycle",
        ),
        ({"coords": {}}, "time: missing"),
    ],
)
def test_arrays_of_wrong_shape_are_refused(errors, changes, message) -> None:
    with pytest.raises(DatasetError, match=message):
        errors(**changes)


@pytest.mark.parametrize(
    ("time", "message"),
    [
        ([0, 1, 2, 2, 3, 4, 5.0], "increasing seconds; found 2 s after 2 s"),
        ([0, 1, 2, np.nan, 3, 4, 5.0], "finite seconds; found nan"),
    ],
)
def test_times_increase(errors, time, message) -> None:
    with pytest.raises(DatasetError, match=message):
        errors(coords={"time": np.array(time)})


def test_a_covariance_is_symmetric_and_positive(errors) -> None:
    ds = errors(influence=None)
    skew = ds.copy(deep=True)
    skew["covariance"][3, 0, 1] *= 1.001
    assert violations(skew) == "covariance: expected symmetric matrices; found one that is not"
    negative = ds.copy(deep=True)
    negative["covariance"][3, 2, 2] *= -1
    assert "expected variances of 0 or more" in violations(negative)
    assert violations(negative).endswith("of EZ")
    overdone = ds.copy(deep=True)
    u = np.sqrt(np.diagonal(overdone["covariance"].values[3]))
    overdone["covariance"][3, 0, 1] = overdone["covariance"][3, 1, 0] = 1.1 * u[0] * u[1]
    assert "positive semidefinite" in violations(overdone)


def test_rounding_of_a_singular_covariance_is_accepted(errors) -> None:
    rng = np.random.default_rng(0)
    F = rng.normal(size=(2, 7, 6)) * 1e-6  # rank 2: four eigenvalues are zero up to rounding
    C = np.einsum("spi,spj->pij", F, F)
    assert datasets.violations(errors(covariance=C, influence=F, sources=["a", "b"], source_groups=["a", "b"])) == []


def test_influence_is_not_larger_than_the_covariance(errors) -> None:
    ds = errors()
    ds["influence"][0, 2, 4] = 1e-4
    assert "for EB they exceed it" in violations(ds)


def test_the_covariance_minus_the_influences_is_a_covariance(errors) -> None:
    F = np.zeros((1, 7, 6))
    F[0, :, 0] = F[0, :, 1] = 0.9e-6
    message = "expected the covariance minus the influences to be a covariance"
    with pytest.raises(DatasetError, match=message):
        # each variance contains its influence, but the correlation of the two freedoms by the common source is missing
        errors(covariance=np.tile(np.eye(6) * 1e-12, (7, 1, 1)), influence=F, sources=["a"], source_groups=["a"])


def test_value_and_covariance_are_nan_together(errors) -> None:
    ds = errors()
    ds["EY"][2] = np.nan
    message = violations(ds)
    assert "covariance: expected NaN exactly where the value is NaN" in message
    assert "EY" in message


def test_missing_freedoms_and_attributes_are_named(errors) -> None:
    ds = errors().drop_vars(["EB", "EC"])
    del ds.attrs["frame"]
    ds.attrs["provenance"] = "none"
    ds.attrs["operator"] = None
    message = violations(ds)
    assert "EB EC: missing" in message
    assert "attribute 'frame': missing" in message
    assert "provenance': expected a JSON object" in message
    assert "attribute 'operator': expected text, a number or a flat array of them; found None" in message


def test_a_unit_other_than_si_is_refused(errors) -> None:
    ds = errors()
    ds["EX"].attrs["units"] = "um"
    assert violations(ds) == "EX: expected units 'm'; found 'um'. Convert the values and set the attribute"


def test_the_order_of_freedoms_is_fixed(errors) -> None:
    ds = errors().isel(dof=[1, 0, 2, 3, 4, 5])
    assert "dof: expected EX EY EZ EA EB EC; found EY EX EZ EA EB EC: in another order" in violations(ds)


def test_an_unknown_schema_is_refused_with_the_nearest(errors) -> None:
    ds = errors().assign_attrs(schema="errormotion.raw.spindle_drfit/1")
    assert "did you mean 'errormotion.raw.spindle_drift/1'?" in violations(ds)
    del ds.attrs["schema"]
    assert "attribute 'schema': missing" in violations(ds)


def test_fifty_thousand_instants_are_checked_completely(errors) -> None:
    ds = errors(n=50_000)
    ds["covariance"][49_999, 0, 1] *= 2
    assert "symmetric" in violations(ds)


def test_doubts_are_notes_that_are_also_stated_by_themselves(errors, tmp_path) -> None:
    plain = errors(notes=["Cold.", ""])
    assert plain.em.notes == ["Cold."]
    assert plain.em.doubts == []
    doubted = errors(notes=["Cold."], doubts=["Two readings contradict each other.", ""])
    assert doubted.em.notes == ["Cold.", "Two readings contradict each other."]
    datasets.save(doubted, tmp_path / "e.nc")
    assert datasets.load(tmp_path / "e.nc").em.doubts == ["Two readings contradict each other."]
