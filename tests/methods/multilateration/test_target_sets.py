"""Choice of targets: compared with random ones and simulated measurements, lines of sight, and wrong input."""

import tomllib

import numpy as np
import pytest

from errormotion import datasets
from errormotion.errors import MethodError
from errormotion.kinematics.twists import rigid_motions
from errormotion.methods.multilateration import Multilateration
from errormotion.methods.multilateration.axes import fit_machine
from errormotion.methods.multilateration.networks import bound, solve
from errormotion.methods.multilateration.planning import layout
from errormotion.methods.multilateration.planning.choosing import positions, refuse_count
from errormotion.methods.multilateration.planning.sight import Sight
from errormotion.methods.multilateration.planning.target_sets import Expected, Volume
from errormotion.methods.multilateration.result import OF_DATUM
from errormotion.methods.multilateration.settings import Choosing, MultilaterationSettings, Planning

CHAIN = "workpiece-X-Y-bed-Z-spindle-tool"
STATIONS = np.array([(-0.75, -0.6, -0.1), (0.8, -0.55, 0.0), (0.7, 0.65, -0.05), (-0.6, 0.5, 0.8)])
LOW, HIGH = (-0.2, -0.15, 0.05), (0.2, 0.15, 0.4)
REFLECTOR = np.array([0.02, -0.01, -0.08])
NOISE = 0.5e-6
GRID = positions(Choosing(count=20, candidates=(5, 5, 5)), LOW, HIGH)


def volume(kind, sees=None, position=GRID):
    expected = Expected.of(CHAIN, position, REFLECTOR, 4, 10e-6, 20e-6) if kind == "axes" else None
    sees = np.ones((4, len(position)), bool) if sees is None else sees
    return Volume.of(STATIONS, position + REFLECTOR, sees, NOISE, expected, len(position))


def cost(worth, minimise):
    return np.nanmax(worth) if minimise == "largest" else np.nanmean(worth)


@pytest.mark.parametrize("kind", ["target", "axes"])
@pytest.mark.parametrize("minimise", ["largest", "mean"])
def test_the_chosen_set_is_better_than_the_best_of_many_random_ones(kind, minimise):
    v = volume(kind)
    chosen = v.choose(20, minimise)
    assert len(set(chosen)) == 20
    rng = np.random.default_rng(1)
    drawn = [v.worth(rng.choice(len(GRID), 20, replace=False)) for _ in range(300)]
    found = cost(v.worth(chosen), minimise)
    assert found < min(cost(each, minimise) for each in drawn)
    # Not by luck alone: what a set drawn by chance leaves in the mean is far more.
    assert found < 0.8 * np.mean([cost(each, minimise) for each in drawn])


def test_no_exchange_of_one_target_improves_the_choice():
    v = volume("target")
    chosen = v.choose(12, "mean")
    found = np.mean(v.worth(chosen))
    others = [k for k in range(len(GRID)) if k not in chosen]
    for out in range(0, 12, 3):
        for new in others[::7]:
            assert np.mean(v.worth([*chosen[:out], *chosen[out + 1 :], new])) > found * (1 - 1e-4)


def test_with_all_candidates_measured_the_uncertainty_is_that_of_the_bound():
    place = GRID + REFLECTOR
    everything = bound(place, STATIONS, noise=NOISE)
    own = np.sqrt(np.trace(everything.covariance, axis1=1, axis2=2))
    # What is left is the share of their own noise in the datum: 6 motions of 375 coordinates.
    np.testing.assert_allclose(volume("target").worth(range(len(place))), own, rtol=0.04)


def test_the_prediction_for_a_further_target_is_the_scatter_of_measurements():
    v = volume("target")
    chosen = np.array(v.choose(20, "largest"))
    place = GRID + REFLECTOR
    d = np.linalg.norm(place - STATIONS[:, None], axis=2)
    G = rigid_motions(place, place.mean(axis=0)).reshape(-1, 6)
    rng = np.random.default_rng(2)
    off = []
    for _ in range(200):
        first = d + NOISE * rng.normal(size=d.shape)
        network = solve(first[:, chosen], place[chosen], STATIONS, noise=NOISE, robust=False)
        # All candidates are read anew, from the stations as found with the chosen ones.
        again = d + NOISE * rng.normal(size=d.shape)
        u = place.copy()
        for _ in range(4):
            way = u - network.stations.position[:, None]
            length = np.linalg.norm(way, axis=2)
            E, r = (
                (way / length[..., None]).transpose(1, 0, 2),
                (again - (length - network.stations.dead_path[:, None])).T,
            )
            u = u + np.linalg.solve(E.transpose(0, 2, 1) @ E, np.einsum("kja,kj->ka", E, r)[..., None])[..., 0]
        change = (u - place).ravel()
        off.append((change - G @ np.linalg.lstsq(G, change)[0]).reshape(place.shape))
    scatter = np.sqrt((np.array(off) ** 2).sum(axis=2).mean(axis=0))
    # 200 runs leave some 4 % of a standard deviation, of 125 places; the fit of six motions takes 2 % away.
    assert np.abs(scatter / v.worth(chosen) - 1).max() < 0.2
    assert np.mean(scatter / v.worth(chosen)) == pytest.approx(1.0, abs=0.05)


def test_the_prediction_for_the_axes_is_the_scatter_of_fits():
    v = volume("axes")
    chosen = np.array(v.choose(40, "mean"))
    expected = Expected.of(CHAIN, GRID, REFLECTOR, 4, 10e-6, 20e-6)
    place = GRID + REFLECTOR
    G = rigid_motions(place, place.mean(axis=0)).reshape(-1, 6)
    rng = np.random.default_rng(3)
    off = []
    for _ in range(25):
        true = expected.columns @ (expected.size * rng.normal(size=len(expected.size)))
        there = (place + true)[chosen]
        d = np.linalg.norm(there - STATIONS[:, None], axis=2)
        d = d + NOISE * rng.normal(size=d.shape)
        network = solve(d, place[chosen], STATIONS, noise=NOISE, robust=False)
        solved = network.solved
        influence = np.array([each.effect for each in solved.relative.errors.sources if each.joined not in OF_DATUM])
        axes = fit_machine(
            CHAIN, GRID[chosen], network.target - place[chosen], solved.factor * solved.fit.normal.own, influence,
            reflector=np.tile(REFLECTOR, (len(chosen), 1)), max_order=4,
        )  # fmt: skip
        found = axes.volume.columns(axes.terms, GRID, np.tile(REFLECTOR, (len(GRID), 1))) @ axes.coefficient
        change = (found - true).ravel()
        off.append((change - G @ np.linalg.lstsq(G, change)[0]).reshape(place.shape))
    scatter = np.sqrt((np.array(off) ** 2).sum(axis=2).mean())
    # The fit has to find out how large the motions are, which the prediction knows: it may be some percent worse.
    assert scatter == pytest.approx(np.sqrt(np.mean(v.worth(chosen) ** 2)), rel=0.2)


def test_targets_that_are_not_visible_are_not_chosen():
    place = GRID + REFLECTOR
    sight = Sight.of(Planning(obstacles=({"low": (-0.5, -0.45, -0.4), "high": (-0.3, 0.0, 0.9)},), acceptance=np.pi))
    sees = sight.sees(STATIONS, place)
    sees[:2, 62] = False  # and one in the middle is seen by two stations only
    assert not sees.all()
    v = volume("target", sees)
    assert not v.fine[62]
    chosen = v.choose(30, "mean")
    assert v.fine[chosen].all()
    assert np.isnan(v.worth(chosen)[62])
    # The errors of the axes are known there all the same.
    assert np.isfinite(volume("axes", sees).worth(chosen)).all()


SETTINGS = {
    "chain": CHAIN,
    "layout": {
        "low": LOW, "high": HIGH, "count": (3, 3, 3), "reflector": tuple(REFLECTOR), "displacement_noise": NOISE,
        "stations": [tuple(U) for U in STATIONS],
    },
}  # fmt: skip
# Two stations may move a little: the search is short.
BOXES = [
    {"low": tuple(U - room), "high": tuple(U + room)}
    for U, room in zip(STATIONS, ((0.1, 0.1, 0.0), (0, 0, 0), (0, 0, 0), (0.0, 0.0, 0.2)), strict=True)
]


def planned(**changes):
    targets = {"count": 27, "candidates": (4, 4, 4), "uncertainty": "target"} | changes
    settings = MultilaterationSettings(
        **SETTINGS, planning={"boxes": BOXES, "targets": targets, "acceptance": np.radians(50)}
    )
    return settings, Multilateration().plan(settings)


@pytest.fixture(scope="module")
def made():
    return planned()


def test_a_plan_states_the_volume_the_gain_and_the_targets(made):
    settings, ds = made
    datasets.validate(ds)
    assert ds["map_uncertainty"].shape == (2, 64)
    assert int(ds["chosen"].sum()) == 27
    own, best = ds["largest_uncertainty"].values
    assert float(ds["gain"]) == pytest.approx(own / best)
    assert best < own
    text = "\n".join(ds.attrs["notes"])
    assert "27 of 64 candidates are chosen as targets" in text
    assert "smaller by the factor" in text
    assert "Uncertainty over the volume, um, as set | best" in text
    station = ds["best_place"].values
    for U, box in zip(station, settings.planning.boxes, strict=True):
        assert np.all(np.array(box.low) - 1e-12 <= U)
        assert np.all(np.array(box.high) + 1e-12 >= U)


def test_chosen_targets_are_within_the_acceptance_angle_of_the_reflector(made):
    _, ds = made
    place = ds["map_position"].values + REFLECTOR
    chosen = ds["chosen"].values == 1
    back = ds["best_place"].values[:, None] - place
    axis = ds["best_place"].values - place.mean(axis=0)
    along = np.sum(back * axis[:, None], axis=2) / np.linalg.norm(back, axis=2) / np.linalg.norm(axis, axis=1)[:, None]
    seen = ds["best_sees"].values == 1
    assert (np.degrees(np.arccos(along))[seen] < 50 + 1e-6).all()
    assert (seen.sum(axis=0)[chosen] >= 3).all()


def test_a_campaign_measures_the_chosen_targets(made, tmp_path):
    _, ds = made
    text = tomllib.loads(ds.attrs["best_layout"])["test"]["settings"]["layout"]
    again = MultilaterationSettings(layout=text)
    position, place = layout.grid(again.layout)
    np.testing.assert_allclose(position, ds["map_position"].values[ds["chosen"].values == 1], atol=0.5e-6)
    np.testing.assert_allclose(place - position, np.tile(REFLECTOR, (27, 1)), atol=1e-12)
    np.testing.assert_allclose(again.layout.stations, ds["best_place"].values, atol=0.5e-3)
    order = layout.route(again.layout)
    assert sorted(order) == list(range(27))
    tour, listed = (np.abs(np.diff(way, axis=0)).max(axis=1).sum() for way in (position[order], position))
    assert tour < listed
    file = tmp_path / "best.toml"
    where = MultilaterationSettings(
        **SETTINGS, planning={"boxes": [{"low": U, "high": U} for U in map(tuple, STATIONS)], "write": file}
    )
    assert f"The best layout is in {file}" in "\n".join(Multilateration().plan(where).attrs["notes"])
    assert tomllib.loads(file.read_text())["test"]["settings"]["layout"]["count"] == [3, 3, 3]
    with pytest.raises(MethodError, match="the file cannot be created"):
        Multilateration().plan(where)


def test_a_budget_of_time_is_a_number_of_targets():
    assert Choosing(time="10 min", time_per_target="15 s").wanted == 40
    with pytest.raises(ValueError, match="either count"):
        Choosing(time="10 min", count=3)
    with pytest.raises(ValueError, match="either count"):
        Choosing()


def test_wrong_settings_are_refused_with_a_remedy():
    with pytest.raises(MethodError, match=r"Expected at most 64 targets.*found 65. Choose fewer"):
        planned(count=65)
    with pytest.raises(MethodError, match=r"at least 10 targets for 4 stations.*found 9. Choose more"):
        planned(count=9)
    travel = {"low": (-0.3, -0.2, 0.1), "high": (0.3, 0.2, 0.5)}
    with pytest.raises(MethodError, match=r"expected a box within the travel, \(-300, -200, 100\) mm"):
        planned(travel=travel)
    with pytest.raises(ValueError, match="both low and high, the corners"):
        Choosing(count=12, low=(0, 0, 0))
    with pytest.raises(MethodError, match="chain: expected the chain of the machine"):
        Multilateration().plan(
            MultilaterationSettings(
                layout=SETTINGS["layout"], planning={"targets": {"count": 20, "candidates": (3, 3, 3)}}
            ),
        )


@pytest.mark.parametrize(("stations", "least"), [(4, 10), (5, 7), (6, 6), (8, 6)])
def test_the_minimum_number_of_targets_is_that_of_the_unknowns(stations, least):
    # n m readings for 3 m + 4 n - 6 unknowns.
    assert stations * least >= 3 * least + 4 * stations - 6
    assert stations * (least - 1) < 3 * (least - 1) + 4 * stations - 6
    refuse_count(least, 100, stations)
    with pytest.raises(MethodError, match=f"at least {least} targets"):
        refuse_count(least - 1, 100, stations)
