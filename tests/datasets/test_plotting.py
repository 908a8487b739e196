"""The figures of error datasets: drawn elements, and refused forms."""

import numpy as np
import pytest
from coded import raises
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection

GRID = np.stack(np.meshgrid([0.0, 0.4], [0.0, 0.3], [0.0, 0.2], indexing="ij"), axis=-1).reshape(-1, 3)


def volume(errors, **changes):
    names = [f"T{k}" for k in range(8)]
    places = {axis: ("target", GRID[:, k]) for k, axis in enumerate("xyz")}
    return errors(
        n=8, dims=("target",), component="tool", coords={"target": names, **places}, **{"unseen": (3, 4, 5), **changes}
    )


def over_time(errors, positions=12):
    rng, n = np.random.default_rng(5), 10
    return errors(
        values=rng.normal(size=(n, positions, 6)) * 1e-5,
        covariance=np.tile(np.eye(6) * 1e-12, (n, positions, 1, 1)),
        influence=None, sources=None, source_groups=None,
        dims=("time", "position"),
        component="Y",
        coords={"time": 600.0 * np.arange(n), "y": ("position", np.linspace(0, 1, positions))},
    )  # fmt: skip


def test_arrows_in_a_volume_point_along_the_displacements(errors) -> None:
    ds = volume(errors)
    figure = ds.em.plot()
    figure.draw_without_rendering()
    (axes,) = (axes for axes in figure.axes if axes.name == "3d")
    (arrows,) = (each for each in axes.collections if isinstance(each, Line3DCollection))
    shafts = np.array([np.asarray(segment)[::-1] for segment in arrows._segments3d[:8]])
    np.testing.assert_allclose(shafts[:, 0], 1e3 * GRID)
    E = np.stack([ds[name].values for name in ("EX", "EY", "EZ")], axis=-1)
    along = shafts[:, 1] - shafts[:, 0]
    scale = np.linalg.norm(along, axis=1) / np.linalg.norm(E, axis=1)
    np.testing.assert_allclose(along, scale[0] * E, rtol=1e-9)
    longest = 1e6 * np.linalg.norm(E, axis=1).max()
    assert f"longest arrow {longest:.3g} um" in axes.get_title()
    assert {text.get_text().strip() for text in axes.texts} == {f"T{k}" for k in range(8)}


def test_an_unknown_target_is_counted(errors) -> None:
    ds = volume(errors)
    for name in ("EX", "covariance", "influence"):
        ds[name].values[(slice(None), 2) if name == "influence" else 2] = np.nan
    assert "1 unknown" in ds.em.plot().axes[0].get_title()


def test_a_long_and_wide_result_is_a_map_and_a_narrow_one_lines(errors) -> None:
    ds = over_time(errors)
    figure = ds.em.plot(["EXY", "EZ"])
    figure.draw_without_rendering()
    first = figure.axes[0]
    (cells,) = first.collections
    np.testing.assert_allclose(cells.get_array(), 1e6 * ds["EX"].values.T)
    assert (first.get_xlabel(), first.get_ylabel()) == ("", "y position / mm")  # the lower panel has the label of both
    assert first.get_title(loc="left") == "EXY, U up to 2 um (k = 2)"
    lines = over_time(errors, positions=3).em.plot("EX").axes[0]
    assert [text.get_text() for text in lines.get_legend().get_texts()] == ["0", "500", "1000"]
    assert (lines.get_xlabel(), lines.get_ylabel()) == ("time / min", "EXY / um")


def test_freedoms_point_factor_and_axes_are_chosen(errors) -> None:
    ds = errors()
    axes = Figure().subplots()
    point = (0.0, 0.0, 0.3)
    figure = ds.em.plot(freedoms="EY", at=point, k=3, ax=axes)
    assert figure is axes.figure
    np.testing.assert_allclose(axes.get_lines()[0].get_ydata(), 1e6 * ds.em.at(point)["EY"])
    (band,) = axes.collections
    height = band.get_paths()[0].vertices[:, 1].max()
    U = 3e6 * np.sqrt(ds.em.at(point)["covariance"].values[:, 1, 1])
    assert height == pytest.approx((1e6 * ds.em.at(point)["EY"].values + U).max(), rel=1e-9)
    assert not ds.em.plot("EY", k=0).axes[0].collections


def test_two_units_need_two_axes(errors) -> None:
    figure = Figure()
    pair = figure.subplots(2)
    assert errors().em.plot(ax=pair) is figure
    with raises("plot.axes.count"):
        errors().em.plot(ax=pair[0])


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ({"freedoms": "EQ"}, "errors.freedoms.unknown"),
        ({"freedoms": []}, "errors.freedoms.unknown"),
        ({"k": -1}, "plot.coverage_factor"),
        ({"form": "map"}, "plot.map.dims"),
        ({"form": "arrows"}, "plot.arrows.no_targets"),
        ({"form": "pie"}, "plot.form.unknown"),
    ],
)
def test_what_cannot_be_drawn_is_refused(errors, arguments, code) -> None:
    with raises(code):
        errors().em.plot(**arguments)


def test_flat_axes_show_bars_at_targets_and_arrows_need_space(errors) -> None:
    ds = volume(errors)
    axes = Figure().subplots()
    ds.em.plot(ax=axes)
    assert [tick.get_text() for tick in axes.get_xticklabels()] == [f"T{k}" for k in range(8)]
    with raises("plot.axes.projection"):
        ds.em.plot(ax=axes, form="arrows")


def test_names_in_data_are_drawn_as_text(errors) -> None:
    strange = "$\\frac{<script>$ and a name that goes on and on"
    ds = volume(errors, machine=strange).assign_coords(target=[strange, *(f"T{k}" for k in range(1, 8))])
    for form in ("arrows", "curves"):
        ds.em.plot(form=form).draw_without_rendering()
