"""Expected uncertainty of a layout: compared with simulated measurements, and with the best layout."""

import numpy as np
import pytest
from coded import raises

from errormotion import datasets
from errormotion.errors import MethodError
from errormotion.methods.multilateration import Multilateration
from errormotion.methods.multilateration.networks import solve
from errormotion.methods.multilateration.planning import layout
from errormotion.methods.multilateration.planning.plan import boxes_of, reading_noise
from errormotion.methods.multilateration.settings import Box, MultilaterationSettings, Planning

pytestmark = pytest.mark.usefixtures("short_searches")

CLOSE = ((-0.3, -0.1, 0.0), (-0.3, 0.0, 0.1), (-0.3, 0.1, 0.0), (0.0, 0.05, 0.6))
LAYOUT = {
    "low": (-0.1, -0.1, 0.0), "high": (0.1, 0.1, 0.2), "count": (3, 3, 3), "stations": CLOSE,
    "displacement_noise": 1e-6,
}  # fmt: skip
ROOM = Planning(boxes=(Box(low=(-0.35, -0.35, -0.1), high=(0.35, 0.35, 0.6)),), acceptance=np.pi)
NARROW = Planning(boxes=tuple(Box(low=U, high=U) for U in CLOSE), acceptance=np.pi)
"""No station may move."""
STILL = {
    "temperature_uncertainty": 0.0, "pressure_uncertainty": 0.0, "humidity_uncertainty": 0.0,
    "wavelength_uncertainty": 0.0,
}  # fmt: skip


def planned(planning=ROOM, **changes):
    return Multilateration().plan(MultilaterationSettings(**({"layout": LAYOUT, "planning": planning} | changes)))


@pytest.fixture(scope="module")
def ds(short_searches):
    return planned()


def test_a_plan_is_an_error_dataset_of_zeros_that_conforms_to_the_schema(ds):
    datasets.validate(ds)
    for name in ("EX", "EY", "EZ"):
        assert not ds[name].values.any()
    assert np.isnan(ds["EA"].values).all()
    assert ds.sizes["target"] == 27


def test_expected_uncertainty_is_the_scatter_of_measurements():
    settings = MultilaterationSettings(layout=LAYOUT, air=STILL, scale_uncertainty=0.0, planning=NARROW)
    ds = Multilateration().plan(settings)
    target, U = layout.grid(settings.layout)[1], np.array(CLOSE)
    rng = np.random.default_rng(2)
    d = np.linalg.norm(target - U[:, None], axis=-1)
    runs = [solve(d + 1e-6 * rng.normal(size=d.shape), target, U, noise=1e-6, robust=False).target for _ in range(150)]
    scatter = np.sqrt(((np.array(runs) - target) ** 2).sum(axis=-1).mean(axis=0))
    # 150 runs: some 5 % of a standard deviation, and 27 targets that share their stations. Beyond the linear
    # prediction comes what a close layout bends.
    assert np.abs(scatter / ds["target_uncertainty"].values - 1).max() < 0.2
    variance = np.trace(ds["covariance"].values[:, :3, :3], axis1=1, axis2=2)
    # What the air's own equations leave, 1e-8 of 0.2 m, is nothing here.
    np.testing.assert_allclose(np.sqrt(variance), ds["target_uncertainty"].values, rtol=1e-4)


def test_the_gain_over_the_layout_as_set_is_stated(ds):
    own, best = ds["largest_uncertainty"].values
    assert float(ds["gain"]) == pytest.approx(own / best)
    assert float(ds["gain"]) > 3  # three stations close together are bad
    assert ds["target_uncertainty"].values.max() == pytest.approx(own)
    assert ds["map_uncertainty"].sel(setup="best").values.max() == pytest.approx(best)
    low, high = boxes_of(ROOM, np.array(CLOSE), np.zeros((1, 3)))[0]
    assert np.all(ds["best_place"].values >= low)
    assert np.all(ds["best_place"].values <= high)
    text = "\n".join(ds.attrs["notes"])
    assert "is at most" in text
    assert "smaller by the factor" in text


def test_uncertainty_of_the_air_is_one_scale_for_all_targets(ds):
    still = planned(NARROW, air=STILL)
    assert "air temperature" not in still["source"].values
    scale = ds["influence"].sel(source="air temperature").values[:, :3]
    target = layout.grid(MultilaterationSettings(layout=LAYOUT).layout)[1]
    # 0.2 K of air: 0.95 um/m a kelvin.
    np.testing.assert_allclose(scale, 0.19e-6 * (target - target.mean(axis=0)), rtol=0.02, atol=1e-12)


def test_the_uncertainty_of_the_expansion_is_in_the_plan():
    expansion = {"coefficient": 11.5e-6, "temperature_uncertainty": 0.5, "temperature": 22.0}
    ds = planned(NARROW, expansion=expansion)
    groups = dict(zip(ds["source"].values, ds["source_group"].values, strict=True))
    assert groups["scale temperature X"] == "scales"
    along = ds["influence"].sel(source="scale temperature X").values
    x = ds["x"].values
    # 0.5 K of 11.5 um/m/K make the grid as commanded longer along X, and nothing else, but for the beams of stations
    # that follow from the readings to 1e-5 of their direction.
    np.testing.assert_allclose(np.abs(along[:, 0]), 5.75e-6 * np.abs(x - x.mean()), atol=2e-11)
    np.testing.assert_allclose(along[:, 1:3], 0, atol=2e-11)


def test_repeatability_is_included_with_separate_set_ups():
    settings = MultilaterationSettings(layout=LAYOUT, repeatability=2e-6)
    assert reading_noise(settings) == pytest.approx(np.sqrt(5) * 1e-6)
    assert reading_noise(settings.model_copy(update={"together": True})) == pytest.approx(1e-6)


def test_without_freedom_the_best_layout_is_that_of_the_settings():
    ds = planned(NARROW)
    assert float(ds["gain"]) == 1.0
    np.testing.assert_array_equal(ds["best_place"].values, CLOSE)
    assert "No better layout was found within the boxes." in ds.attrs["notes"]


def test_blocked_lines_of_sight_and_undetermined_targets_are_counted():
    # A pillar close to one target hides it from the three stations that stand together, two of which may move.
    pillar = Box(low=(-0.13, -0.02, 0.08), high=(-0.12, 0.02, 0.12))
    boxes = (*ROOM.boxes * 2, *NARROW.boxes[2:])
    ds = planned(Planning(boxes=boxes, obstacles=(pillar,), acceptance=np.pi))
    text = "\n".join(ds.attrs["notes"])
    assert f"{int((ds['sees'] == 0).sum())} of 108 lines of sight" in text
    unseen = ds["sees"].sum("station").values < 3
    assert np.flatnonzero(unseen).tolist() == [4]
    assert (ds["best_sees"].sum("station") >= 3).all()
    assert np.isnan(ds["EX"].values[unseen]).all()
    assert "visible from fewer than three stations, not determined: 1." in text


def test_boxes_for_another_number_of_stations_are_refused():
    with raises("network.plan.boxes_count"):
        boxes_of(Planning(boxes=ROOM.boxes * 2), np.array(CLOSE), np.zeros((1, 3)))


def test_without_boxes_no_station_is_closer_to_the_targets():
    targets = np.array([[-0.3, -0.2, 0.0], [0.3, 0.2, 0.4]])
    stations = np.array([[-0.8, 0.1, 0.1], [0.7, -0.5, 0.2], [0.0, 0.6, 0.1], [0.1, 0.0, 0.2]])
    boxes = boxes_of(Planning(), stations, targets)
    for (low, high), station in zip(boxes[:3], stations, strict=False):
        assert ((low <= station) & (station <= high)).all()
        assert (low < high).any()  # it may move
        assert ((high < targets.min(axis=0)) | (low > targets.max(axis=0))).any()  # on its side of the targets
    np.testing.assert_array_equal(boxes[3], [stations[3], stations[3]])  # amid the targets: it stays


def test_the_method_has_a_plan():
    flat = MultilaterationSettings(
        layout=LAYOUT | {"count": (2, 2, 2), "stations": [(0.3 * k, 0.2, 0.5) for k in range(-2, 2)]}
    )
    with pytest.raises(MethodError):  # on one line: nothing to be determined
        Multilateration().plan(flat)


def test_groups_and_uncertainties_of_the_plan_are_those_of_the_result():
    stations = MultilaterationSettings().layout.stations
    settings = MultilaterationSettings(
        planning=Planning(boxes=tuple(Box(low=U, high=U) for U in stations), acceptance=np.pi),
        expansion={"coefficient": 11.5e-6, "temperature": 22.0},
        repeatability=0.4e-6,
        noise="stated",
    )
    planned = Multilateration().plan(settings)
    raw, _ = Multilateration().simulate(settings, 1)
    found = Multilateration().identify(raw, settings)
    assert list(dict.fromkeys(planned["source_group"].values)) == list(dict.fromkeys(found["source_group"].values))
    for group in set(planned["source_group"].values):
        one, other = (
            np.sqrt((ds["influence"].values[ds["source_group"].values == group][..., :3] ** 2).sum(axis=0))
            for ds in (planned, found)
        )
        # Targets and stations of the simulated machine differ from the layout by some 1e-4 of their distances; the
        # expansion acts along beams that are known to 5 mm.
        np.testing.assert_allclose(other, one, rtol=0.02, atol=0.005 * one.max())
