import numpy as np
import pytest
import xarray as xr
from coded import raises
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from scipy.spatial.transform import RigidTransform, Rotation

from errormotion import datasets
from errormotion.datasets import DOF
from errormotion.datasets.results.merit import figures_of
from errormotion.errors import DatasetError

coordinates = st.floats(-5.0, 5.0)
points = st.tuples(coordinates, coordinates, coordinates)
angles = st.floats(-np.pi, np.pi)
poses = st.builds(
    lambda turn, shift: RigidTransform.from_components(shift, Rotation.from_rotvec(turn)),
    st.tuples(angles, angles, angles),
    points,
)


def assert_same(back: xr.Dataset, ds: xr.Dataset) -> None:
    """Equal up to rounding of the largest intermediate number."""
    assert set(back.variables) == set(ds.variables)
    lever = 10.0  # m: points and shifts of at most 5 m in each coordinate
    scale = {"EX": 5e-5 * lever, "EA": 5e-5, "covariance": 1e-10 * lever**2, "influence": 5e-6 * lever}
    for name in (*DOF, "covariance", "influence"):
        largest = scale.get(name, scale["EX" if name in DOF[:3] else "EA"])
        np.testing.assert_allclose(back[name], ds[name], rtol=0, atol=100 * np.finfo(float).eps * largest)
    np.testing.assert_allclose(back.attrs["functional_point"], ds.attrs["functional_point"], rtol=0, atol=1e-13)
    kept = set(ds.attrs) - {"functional_point"}
    assert {name: back.attrs[name] for name in kept} == {name: ds.attrs[name] for name in kept}


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 1000), point=points)
def test_to_another_point_and_back_changes_nothing(errors_of_seed, seed, point) -> None:
    ds = errors_of_seed(seed)
    assert_same(ds.em.at(point).em.at(ds.attrs["functional_point"]), ds)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 1000), pose=poses)
def test_to_another_frame_and_back_changes_nothing(errors_of_seed, seed, pose) -> None:
    ds = errors_of_seed(seed)
    assert_same(ds.em.in_frame(pose, "tilted").em.in_frame(pose.inv(), ds.attrs["frame"]), ds)


@pytest.mark.filterwarnings("ignore:The point is .* from the origin")
@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 1000), point=points, pose=poses)
def test_point_and_frame_may_be_changed_in_any_order(errors_of_seed, seed, point, pose) -> None:
    ds = errors_of_seed(seed)
    assert_same(ds.em.at(point).em.in_frame(pose, "f"), ds.em.in_frame(pose, "f").em.at(pose.apply(point)))


def test_a_tilt_becomes_a_displacement_at_the_end_of_the_lever(errors) -> None:
    values = np.zeros((7, 6))
    values[:, 4] = 10e-6  # EB
    C = np.zeros((7, 6, 6))
    C[:, 4, 4] = 1e-12
    ds = errors(values=values, covariance=C, influence=None, functional_point=(0, 0, 0))
    moved = ds.em.at((0, 0, 0.1))
    np.testing.assert_allclose(moved["EX"], 1e-6, rtol=1e-12)  # a turn about Y carries a point at +Z to +X
    np.testing.assert_allclose(moved.em.expanded(k=1).sel(dof="EX"), 1e-7, rtol=1e-12)
    np.testing.assert_array_equal(moved.attrs["functional_point"], [0, 0, 0.1])
    np.testing.assert_array_equal(ds["EX"], 0)


def test_an_undetermined_freedom_affects_only_dependent_values(errors) -> None:
    ds = errors(unseen=(5,), functional_point=(0, 0, 0))
    along = ds.em.at((0, 0, 0.1))
    assert np.isfinite(along.em.twist().sel(dof=list(DOF[:5]))).all()
    across = ds.em.at((0.1, 0, 0))
    assert np.isnan(across["EY"]).all()
    assert np.isfinite(across["EX"]).all()
    for moved in (along, across):
        assert datasets.violations(moved) == []


def test_a_frame_change_rotates_both_parts_and_the_commanded_positions(errors) -> None:
    quarter = RigidTransform.from_components([0, 0, 1.0], Rotation.from_euler("z", 90, degrees=True))
    coords = {"position": np.arange(7.0), **{name: ("position", np.full(7, k / 10)) for k, name in enumerate("xyz")}}
    ds = errors(dims=("position",), coords=coords, component="X", functional_point=(1, 0, 0))
    turned = ds.em.in_frame(quarter, "turned")
    np.testing.assert_allclose(turned["EY"], ds["EX"], rtol=1e-15)
    np.testing.assert_allclose(turned["EB"], ds["EA"], rtol=1e-15)
    np.testing.assert_allclose(turned.attrs["functional_point"], [0, 1, 1], atol=1e-15)
    np.testing.assert_allclose(turned["x"], -0.1)
    np.testing.assert_allclose(turned["z"], 1.2)
    assert turned.attrs["frame"] == "turned"
    assert datasets.violations(turned) == []
    with raises("errors.frame.coordinates"):
        ds.drop_vars("z").em.in_frame(quarter, "turned")


def test_a_mean_is_right_only_through_the_influences(errors) -> None:
    ds = errors(n=5)
    value, covariance = ds.em.combine(np.full(5, 0.2), "time")
    np.testing.assert_allclose(value, ds.em.twist().mean("time"), rtol=1e-12)
    between = sum(ds.em.covariance_between(i, j).values for i in range(5) for j in range(5)) / 25
    np.testing.assert_allclose(covariance, between, rtol=1e-12, atol=1e-24)
    assert covariance.dims == ("dof", "dof_")


def test_a_common_source_cancels_in_a_difference(errors) -> None:
    F = np.full((1, 7, 6), 1e-6)
    C = np.full((7, 6, 6), 1e-12) + np.eye(6) * 4e-14
    ds = errors(covariance=C, influence=F, sources=["bar radius"], source_groups=["bar"])
    weights = np.zeros(7)
    weights[[0, -1]] = -1, 1
    np.testing.assert_allclose(ds.em.combine(weights, "time").covariance, np.eye(6) * 8e-14, rtol=1e-9, atol=1e-24)
    np.testing.assert_allclose(ds.em.covariance_between(0, 6), 1e-12, rtol=1e-12)
    np.testing.assert_allclose(ds.em.covariance_between(2, -5), C[2], rtol=1e-12)


def test_a_point_with_weight_zero_has_no_effect_even_if_unknown(errors) -> None:
    ds = errors()
    values = ds.em.twist().values.copy()
    values[0] = np.nan
    ds = errors(values=values)
    value, covariance = ds.em.combine([0, 1, 0, 0, 0, 0, -1], "time")
    np.testing.assert_allclose(value, values[1] - values[6], rtol=1e-12)
    assert np.isfinite(covariance).all()
    assert np.isnan(ds.em.combine(np.ones(7), "time").value).all()
    assert np.isnan(ds.em.covariance_between(0, 1)).all()


def test_drawing_the_sources_gives_the_covariance_that_is_reported(errors) -> None:
    ds = errors(n=3, seed=5)
    F = ds["influence"].values
    rest = ds["covariance"].values - np.einsum("spi,spj->pij", F, F)
    rng = np.random.default_rng(1)
    draws = np.einsum("ds,spi->dpi", rng.normal(size=(20_000, 3)), F)
    draws += np.einsum("pij,dpj->dpi", np.linalg.cholesky(rest), rng.normal(size=(20_000, 3, 6)))
    combined = draws[:, 2] - 0.5 * draws[:, 0]
    reported = ds.em.combine([-0.5, 0, 1], "time").covariance.values
    scale = np.sqrt(np.outer(np.diag(reported), np.diag(reported)))
    # standard error of a covariance from 20 000 draws: at most sqrt(2 / 20 000) = 1 % of the scale; five of them
    np.testing.assert_allclose(np.cov(combined.T) / scale, reported / scale, atol=0.05)


def test_the_budget_adds_up_to_the_total(errors) -> None:
    ds = errors()
    budget = ds.em.budget()
    assert list(budget["group"].values) == ["beams", "reference", "independent"]
    np.testing.assert_allclose(np.sqrt((budget**2).sum("group")), ds.em.expanded(k=1), rtol=1e-9)
    alone = errors(influence=None).em.budget()
    assert list(alone["group"].values) == ["independent"]


def test_combination_of_inconsistent_datasets_is_refused(errors) -> None:
    ds = errors()
    with raises("errors.dim.unknown"):
        ds.em.combine(np.ones(7), "position")
    with raises("errors.weights.shape"):
        ds.em.combine(np.ones(6), "time")
    with raises("errors.index.outside"):
        ds.em.covariance_between({"time": 0}, 7)
    with raises("errors.point.form"):
        ds.em.at((0, 0))


def test_names_follow_the_component(errors) -> None:
    assert errors().em.iso_names()["EZ"] == "EZC"


def test_extras_are_not_changed(errors) -> None:
    ds = errors(extras={"bar_axis_point": xr.DataArray([0.0, 0.0, 0.0], dims="direction")})
    xr.testing.assert_identical(ds.em.at((1, 2, 3))["bar_axis_point"], ds["bar_axis_point"])


@pytest.mark.parametrize("dim", ["time", "position", "beam", None])
def test_a_plot_shows_um_and_arcsec(errors, dim) -> None:
    changes = {
        "time": {},
        "position": {"dims": ("position",), "coords": {"x": ("position", np.arange(7) / 10)}, "component": "X"},
        "beam": {"dims": ("beam",), "coords": {"beam": list("abcdefg")}, "component": "beam"},
        None: {
            "values": np.full(6, 1e-6),
            "covariance": np.eye(6) * 1e-14,
            "dims": (),
            "coords": {},
            "influence": None,
        },
    }[dim]
    figure = errors(unseen=(5,), **changes).em.plot()
    assert isinstance(figure, Figure)
    upper, lower = figure.axes
    assert (upper.get_ylabel(), lower.get_ylabel()) == ("um", "arcsec")
    figure.draw_without_rendering()


def test_a_curve_is_drawn_in_um_over_minutes(errors) -> None:
    ds = errors(coords={"time": 60.0 * np.arange(7)})
    line = ds.em.plot().axes[0].get_lines()[0]
    np.testing.assert_allclose(line.get_ydata(), 1e6 * ds["EX"], rtol=1e-12)
    np.testing.assert_allclose(line.get_xdata(), np.arange(7), rtol=1e-12)


def test_a_raw_dataset_has_no_errors(drift) -> None:
    with pytest.raises(DatasetError, match="Identify a raw dataset first"):
        drift().em.twist()


def test_a_point_in_mm_is_warned_about(errors_of_seed) -> None:
    with pytest.warns(UserWarning, match="110 m from the origin of its frame"):
        errors_of_seed(0).em.at([0, 0, 110])


def test_a_reduced_covariance_is_refused(errors_of_seed) -> None:
    with raises("errors.covariance.reduced"):
        errors_of_seed(0).mean(keep_attrs=True).em.expanded()


def test_the_accessor_says_what_it_holds(errors_of_seed) -> None:
    ds = errors_of_seed(0)
    shown = repr(ds.em)
    assert f"by {ds.attrs['method']}" in shown
    assert f"{len(ds.em.notes)} notes" in shown
    assert [figure.name for figure in ds.em.figures()] == [figure.name for figure in figures_of(ds)]
