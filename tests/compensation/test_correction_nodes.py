"""Corrections of errors over time and position together, and of targets that span no volume."""

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion.compensation.correction import correction
from errormotion.compensation.correction.nodes import Grid, Line, Scattered, of_targets
from errormotion.datasets import build_errors, provenance
from errormotion.twin import VirtualMachine

TIMES = np.array([0.0, 600.0, 1800.0])
PLACES = np.linspace(-0.2, 0.2, 5)


def warming() -> xr.Dataset:
    """Return errors of Y over time and position: EY = 1e-9 t y / 0.2 and EA = 1e-8 t, with one source and noise."""
    t, y = np.meshgrid(TIMES, PLACES, indexing="ij")
    E = np.zeros((*t.shape, 6))
    E[..., 1], E[..., 3] = 1e-9 * t * y / 0.2, 1e-8 * t
    effect = np.zeros((1, *t.shape, 6))
    effect[..., 1] = 1e-7 * t / 1800
    C = np.einsum("s...i,s...j->...ij", effect, effect) + 1e-16 * np.eye(6)
    return build_errors(
        E, C, dims=("time", "position"),
        coords={"time": TIMES, "y": ("position", PLACES, {"units": "m"})},
        component="Y", machine="m", frame="machine", functional_point=np.zeros(3), reference="cold", method="made",
        method_version="1", provenance=provenance.make({}, None, ()), influence=effect, sources=["laser"],
        source_groups=["laser"], measured={"chain": "workpiece-X-Y-bed-Z-spindle-tool"},
    )  # fmt: skip


@pytest.mark.parametrize("turned", [False, True], ids=["time, position", "position, time"])
def test_errors_over_time_and_position_are_interpolated_in_both(turned: bool) -> None:
    errors = warming()
    if turned:
        errors = errors.transpose("dof", "position", "source", "time", "dof_")
    made = correction(errors)
    asked = np.array([[0.0, 0.05, 0.0], [0.1, -0.13, 0.3], [0.0, 0.2, 0.1]])
    t = np.array([300.0, 1200.0, 1800.0])
    found = made.at(asked, t, covariance=True)
    # Y carries the workpiece: Y itself and Z, which lies behind it, are levers of EA; e = E + R x r
    y, z = asked[:, 1], asked[:, 2]
    expected = np.column_stack([np.zeros(3), 1e-9 * t * y / 0.2 - 1e-8 * t * z, 1e-8 * t * y])
    assert np.abs(found.offset + expected).max() < 1e-10  # the error itself, times its gradient
    assert found.covariance is not None
    assert found.covariance[2, 1, 1] == pytest.approx((1e-7) ** 2 + 1e-16 * (1 + 0.1**2), rel=1e-6)
    assert found.valid.all()
    assert not made.at(asked, 1900.0).valid.any()
    assert not made.at(asked + np.array([0.0, 0.5, 0.0]), t).valid.any()
    assert made.at(asked + np.array([5.0, 0.0, 0.0]), t).valid.all()  # X does not matter to errors of Y


def test_the_lever_of_an_axis_at_the_tool_is_that_of_the_chain() -> None:
    gantry = warming().assign_attrs(chain="workpiece-bed-X-Y-Z-spindle-tool")
    here = np.array([[0.0, 0.1, 0.3]])
    found = correction(gantry).at(here, 1800.0).offset[0]
    assert found[2] == pytest.approx(0.0, abs=1e-12)  # its own travel is no lever: the point rides on the carriage
    assert found[1] == pytest.approx(-1e-9 * 1800 * 0.5 + 1e-8 * 1800 * 0.3, rel=1e-4)
    alone = warming()
    del alone.attrs["chain"]
    assert any("the chain of the machine is unknown" in note for note in correction(alone).notes)


def test_positions_without_errors_at_any_time_are_omitted() -> None:
    errors = warming()
    lost = (errors["position_index"] == 2) | (errors["time_index"] == 1)
    gone = errors.assign({name: errors[name].where(~lost) for name in ("EX", "EY", "EZ", "EA", "EB", "EC")})
    made = correction(gone)
    assert [note.split(": ")[1] for note in made.notes] == [
        "1 of 3 times have no known errors; interpolated from their neighbours.",
        "1 of 5 positions have no known errors; interpolated from their neighbours.",
    ]
    here = np.array([[0.0, 0.02, 0.0]])
    assert np.abs(made.at(here, 700.0).offset - correction(errors).at(here, 700.0).offset).max() < 1e-9
    never = errors.assign(EY=errors["EY"].where((errors["position_index"] + errors["time_index"]) % 2 == 0))
    with raises("correction.positions.unknown"):
        correction(never)


def linear(p: np.ndarray) -> np.ndarray:
    """Return errors that are linear in position, (n, 6): every interpolation is exact."""
    gradient = 1e-5 * np.arange(1, 19).reshape(3, 6)
    return np.asarray(2e-6 + p @ gradient)


@pytest.mark.parametrize(
    ("basis", "count"),
    [
        ([[1.0, 0.5, -0.25]], 9),
        ([[1.0, 0.0, 0.2], [0.0, 1.0, -0.3]], 40),
        (np.eye(3), 90),
    ],
    ids=["line", "plane", "volume"],
)
def test_scattered_nodes_of_any_dimension(basis: list[list[float]], count: int) -> None:
    rng = np.random.default_rng(1)
    directions = np.asarray(basis)
    nodes = [0.1, 0.2, 0.3] + rng.uniform(-0.4, 0.4, (count, len(directions))) @ directions
    places = Scattered(nodes)
    share = rng.dirichlet(np.ones(count), 200)
    inside = share @ nodes
    weights = places.weights(inside)
    assert weights.inside.all()
    assert np.abs(weights.of(linear(nodes)) - linear(inside)).max() < 1e-9
    assert np.abs(weights.weight.sum(axis=0) - 1).max() < 1e-12
    assert places.weights(nodes).inside.all()
    assert not places.weights(nodes + np.array([0.0, 0.0, 2.0])).inside.any()
    added = places.added(inside, linear(nodes), np.zeros((count, 6, 6)))
    assert added.max() < 1e-18  # a linear function has no curvature


def test_one_target_is_valid_at_its_position_only() -> None:
    machine = VirtualMachine("cframe", 3)
    made = correction(machine.volumetric_truth(np.array([[0.1, 0.1, 0.1]])))
    found = made.at(np.array([[0.1, 0.1, 0.1], [0.1, 0.1, 0.2]]))
    assert found.valid.tolist() == [True, False]
    assert np.ptp(found.offset, axis=0).max() == 0


def test_a_grid_is_recognised_in_any_order_but_not_with_gaps() -> None:
    x = np.stack(np.meshgrid([0.0, 0.3, 0.4], [0.0, 1.0], [2.0], indexing="ij"), axis=-1).reshape(-1, 3)
    mixed = x[np.random.default_rng(2).permutation(len(x))] + 1e-12
    found, order = of_targets(mixed)
    assert isinstance(found, Grid)
    assert np.abs(mixed[order] - x).max() < 1e-9
    assert isinstance(of_targets(mixed[1:])[0], Scattered)
    assert isinstance(of_targets(np.concatenate([mixed[:-1], mixed[:1]]))[0], Scattered)  # one target twice


def test_the_curvature_of_scattered_errors_is_in_the_covariance() -> None:
    """Quadratic errors without noise: the stated deviation is that of the interpolation, within a factor of two."""
    rng = np.random.default_rng(4)
    nodes, asked = rng.uniform(0, 1, (400, 3)), rng.uniform(0.2, 0.8, (2000, 3))

    def bent(p: np.ndarray) -> np.ndarray:
        return 1e-5 * (p**2).sum(axis=1, keepdims=True) * np.ones(6)

    places = Scattered(nodes)
    miss = places.weights(asked).of(bent(nodes)) - bent(asked)
    stated = np.sqrt(places.added(asked, bent(nodes), np.zeros((400, 6, 6))))
    assert 0.5 < np.sqrt((stated**2).mean() / (miss**2).mean()) < 2.0


def test_the_uncertainty_between_two_instants_contains_a_step_there() -> None:
    """A step of 3 um deviates from the line by up to 3 um max(w, 1 - w), and 1.96 / sqrt(3) is 1.13."""
    instants, size = np.arange(6) * 600.0, 3e-6
    values = np.zeros((6, 4, 6))
    values[3:] += size
    own = np.tile(1e-18 * np.eye(6), (6, 4, 1, 1))
    line = Line(instants)
    at = np.array([[300.0], [1320.0], [1500.0], [1800.0], [1740.0]])
    u = 1.96 * np.sqrt(line.added_in_time(at, values, own))
    assert (u[[1, 2, 4]] >= size * np.array([[0.8], [0.5], [0.9]])).all()
    assert u[[1, 2, 4]] == pytest.approx(np.tile(size * np.array([[0.8], [0.5], [0.9]]), 6), rel=0.5)
    assert not u[[0, 3]].any()
    assert (1.96 * np.sqrt(line.added(at, values, own))[[1, 2, 4]] < size * 0.5).all()
