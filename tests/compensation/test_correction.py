"""Corrections of commands, against the true errors of virtual machines."""

import time as clock
from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion.compensation.correction import Correction, correction
from errormotion.compensation.thermal_model import ThermalModelSettings, fit
from errormotion.datasets.schemas import DOF
from errormotion.errors import DatasetError
from errormotion.twin import Event, VirtualMachine

KINDS = ("cframe", "gantry")
OFF = {"X": False, "Y": False, "Z": False}


def corners(machine: VirtualMachine) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.array([machine.travel[axis] for axis in "XYZ"]).T
    return low, high


def grid(machine: VirtualMachine, count: int) -> np.ndarray:
    lines = [np.linspace(low, high, count) for low, high in zip(*corners(machine), strict=True)]
    return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)


def places(machine: VirtualMachine, count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(*corners(machine), (count, 3))


def true_error(machine: VirtualMachine, commanded: np.ndarray, tool: np.ndarray | None = None) -> np.ndarray:
    """Return the exact displacement of the tool, (n, 3), by multiplied poses."""
    geometry = machine.geometry
    errors = geometry.machine.errors_at(commanded, geometry.motions, geometry.locations)
    point = np.zeros(3) if tool is None else tool
    return geometry.machine.volumetric_error(commanded, errors, point, exact=True)[:, :3]


def noisy(ds: xr.Dataset, sigma: np.ndarray, rng: np.random.Generator) -> xr.Dataset:
    """Return a measurement of true errors, with independent noise of six standard deviations."""
    out = ds.copy()
    for name, size in zip(DOF, sigma, strict=True):
        out[name] = ds[name] + size * rng.normal(size=ds[name].shape)
    return out.assign(covariance=(ds["covariance"].dims, np.broadcast_to(np.diag(sigma**2), ds["covariance"].shape)))


@pytest.mark.parametrize("kind", KINDS)
def test_corrected_commands_move_the_tool_to_its_position_to_second_order(kind: str) -> None:
    machine = VirtualMachine(kind, 3)
    asked = grid(machine, 5)[::3]  # on the nodes nothing is interpolated
    lines = grid(machine, 21)
    found = correction(machine.volumetric_truth(lines)).at(asked)
    remaining = asked + found.offset + true_error(machine, asked + found.offset) - asked
    before = np.abs(true_error(machine, asked)).max()
    assert before > 10e-6
    # what is left: the rotations' second order and the interpolation over some micrometres
    assert np.abs(remaining).max() < 1e-8
    assert found.valid.all()


@pytest.mark.parametrize("kind", KINDS)
def test_errors_of_axes_are_added_for_any_tool(kind: str) -> None:
    machine = VirtualMachine(kind, 4)
    for name in machine.geometry.locations:
        machine.geometry.locations[name] = 0.0  # type: ignore[index]  # an axis by itself has no squareness
    axes = [
        machine.truth_axis(axis, np.linspace(*machine.travel[axis], 401)).assign_attrs(chain=machine.chain)
        for axis in "XYZ"
    ]
    tool = np.array([0.05, -0.03, -0.2])
    asked = places(machine, 300)
    made = correction(axes, tool)
    found = made.at(asked)
    assert np.abs(found.offset + true_error(machine, asked + found.offset, tool)).max() < 1e-8
    # a longer tool needs another correction, and the levers are known
    assert np.abs(correction(axes).for_tool(tool).at(asked).offset - found.offset).max() < 1e-15
    assert np.abs(correction(axes).at(asked).offset - found.offset).max() > 1e-6


def test_the_residual_rotation_is_that_of_the_tool() -> None:
    machine = VirtualMachine("gantry", 2)
    lines = grid(machine, 9)
    asked = lines[::7]
    found = correction(machine.volumetric_truth(lines)).at(asked)
    assert np.abs(found.residual_rotation - machine.geometry.twist(asked)[:, 3:]).max() < 1e-12


@pytest.mark.parametrize("kind", KINDS)
def test_a_frame_that_rotates_thermally_is_corrected_at_all_positions(kind: str) -> None:
    machine = VirtualMachine(kind, 5)
    machine.start([Event(0.0, 9000.0, OFF)])
    times = np.arange(0.0, 3601.0, 20.0)
    levers = machine.tool_axes
    errors = machine.truth_probing(times)
    made = correction(errors if levers == "XYZ" else errors.assign_attrs(lever_axes=levers))
    asked, when = places(machine, 200), np.random.default_rng(2).uniform(600, 3600, 200)
    found = made.at(asked, when)
    error = machine.thermal_twist(asked + found.offset, when)[:, :3]
    assert np.abs(machine.thermal_twist(asked, when)[:, :3]).max() > 5e-6
    assert np.abs(found.offset + error).max() < 2e-8  # instants 20 s apart


def test_errors_that_change_fast_are_inverted_by_iteration() -> None:
    """A gradient of 0.3: without iteration the correction would deviate by a third."""
    machine = VirtualMachine("cframe", 1)
    errors = machine.truth_axis("X", np.linspace(-0.3, 0.3, 61))
    steep = errors.assign(EX=0.3 * errors["x"], **{name: 0.0 * errors[name] for name in DOF[1:]})
    asked = np.column_stack([np.linspace(-0.2, 0.2, 41), np.zeros((41, 2))])
    found = correction(steep).at(asked)
    assert np.abs(1.3 * (asked + found.offset)[:, 0] - asked[:, 0]).max() < 1e-9
    with raises("correction.not_invertible"):
        correction(errors.assign(EX=-0.09 * np.sin(40 * errors["x"]), **{n: 0.0 * errors[n] for n in DOF[1:]})).at(
            asked
        )


@pytest.mark.parametrize("scattered", [False, True], ids=["grid", "scattered"])
def test_outside_the_measured_range_the_offset_is_constant_and_flagged(scattered: bool) -> None:
    machine = VirtualMachine("cframe", 3)
    nodes = places(machine, 300) if scattered else grid(machine, 6)
    made = correction(machine.volumetric_truth(nodes))
    beyond = made.at(nodes[:1] + np.array([9.0, 0.0, 0.0]), covariance=True).covariance
    assert beyond is not None
    assert np.isnan(beyond).all()  # nothing is known there
    centre = nodes.mean(axis=0)
    direction = np.array([1.0, -0.6, 0.3]) / np.linalg.norm([1.0, -0.6, 0.3])
    way = centre + np.linspace(0, 1.5, 3001)[:, None] * direction
    found = made.at(way)
    assert found.valid[0]
    assert not found.valid[-1]
    assert (np.diff(found.valid.astype(int)) <= 0).all()
    steps = np.abs(np.diff(found.offset, axis=0)).max(axis=1)
    assert steps.max() < 1e-6  # no jump at the edge, 0.5 mm a step
    held = found.offset[~found.valid]
    if scattered:  # every point of the way is moved to one point of the hull, but for the offset itself
        assert np.abs(held - held[-1]).max() < 1e-9
    assert np.abs(found.offset[-1]).max() <= np.abs(machine.geometry.twist(nodes)[:, :3]).max()


def test_before_and_after_the_measurement_the_nearest_correction_applies() -> None:
    machine = VirtualMachine("cframe", 5)
    machine.start([Event(0.0, 9000.0, OFF)])
    made = correction(machine.truth_spindle(np.arange(0.0, 1801.0, 60.0)))
    here = np.zeros((3, 3))
    found = made.at(here, [1800.0, 1900.0, 1e6])
    assert found.valid.tolist() == [True, False, False]
    assert np.ptp(found.offset, axis=0).max() == 0
    with raises("correction.time.missing"):
        made.at(here)


def coverage(made: Correction, machine: VirtualMachine, asked: np.ndarray) -> np.ndarray:
    """Return squared Mahalanobis distances of the true remaining errors."""
    found = made.at(asked, covariance=True)
    remaining = found.offset + true_error(machine, asked + found.offset)
    assert found.covariance is not None
    return np.einsum("ni,nij,nj->n", remaining, np.linalg.inv(found.covariance), remaining)


def test_the_covariance_covers_the_remaining_errors() -> None:
    """60 measurements of one machine with independent noise, at 12 positions each, on and between the nodes."""
    machine = VirtualMachine("cframe", 6)
    truth = machine.volumetric_truth(grid(machine, 9))
    rng = np.random.default_rng(7)
    sigma = np.array([0.4e-6, 0.5e-6, 0.6e-6, 1e-6, 1e-6, 1e-6])
    asked = places(machine, 12, seed=3)
    distance = np.array([coverage(correction(noisy(truth, sigma, rng)), machine, asked) for _ in range(60)])
    assert distance.mean() == pytest.approx(3.0, rel=0.25)  # chi-square with three degrees of freedom
    assert 0.9 < (distance < 7.81).mean() <= 1.0


def test_a_source_of_all_axes_is_fully_correlated() -> None:
    """One calibration of two axes: its effects are added before they are squared."""
    machine = VirtualMachine("cframe", 6)
    axes = []
    for axis in "XY":
        ds = machine.truth_axis(axis, np.linspace(*machine.travel[axis], 5))
        effect = np.zeros((1, 5, 6))
        effect[..., 0] = 1e-6
        ds = ds.assign(
            influence=(("source", "position", "dof"), effect),
            covariance=(ds["covariance"].dims, np.einsum("sni,snj->nij", effect, effect)),
        ).assign_coords(source=["laser"], source_group=("source", ["laser"]), source_id=("source", ["laser 12"]))
        axes.append(ds)
    here = np.array([[axes[0]["x"].values[2], axes[1]["y"].values[2], 0.0]])
    found = correction(axes).at(here, covariance=True).covariance
    assert found is not None
    assert found[0, 0, 0] == pytest.approx((2e-6) ** 2)
    apart = [axes[0], axes[1].assign_coords(source_id=("source", ["laser 13"]))]
    other = correction(apart).at(here, covariance=True).covariance
    assert other is not None
    assert other[0, 0, 0] == pytest.approx(2 * (1e-6) ** 2)


def test_unknown_freedoms_are_an_error_or_omitted() -> None:
    machine = VirtualMachine("cframe", 6)
    ds = machine.truth_axis("Y", np.linspace(*machine.travel["Y"], 9))
    alone = ds.assign({name: ds[name] * np.nan for name in DOF if name != "EY"})
    C = np.full((9, 6, 6), np.nan)
    C[:, 1, 1] = 1e-14
    alone = alone.assign(covariance=(ds["covariance"].dims, C))
    with raises("correction.freedoms.unknown"):
        correction(alone)
    made = correction(alone, partial=True)
    found = made.at(np.zeros((1, 3)), covariance=True)
    assert made.left == ("EX", "EZ")
    assert any("EX, EZ" in note for note in made.notes)
    assert found.covariance is not None
    assert np.isnan(found.covariance[0, 0, 0])
    assert np.isfinite(found.covariance[0, 1, 1])
    assert np.isnan(found.residual_rotation).all()


def test_an_unknown_rotation_is_refused_where_it_moves_the_tool() -> None:
    machine = VirtualMachine("cframe", 6)
    ds = machine.volumetric_truth(grid(machine, 3))
    ds = ds.assign(EC=ds["EC"] * np.nan)
    along_z = correction(ds, [0.0, 0.0, -0.1])  # EC has no lever there
    assert np.isnan(along_z.at(np.zeros((1, 3))).residual_rotation[0]).tolist() == [False, False, True]
    with pytest.raises(DatasetError, match="EC is unknown"):
        along_z.for_tool([0.1, 0.0, -0.1])


def test_a_thermal_model_corrects_and_flags_inputs_outside_its_training(
    warm_up: Callable[..., xr.Dataset], pair: list[xr.Dataset]
) -> None:
    model = fit(pair, ThermalModelSettings(variant="lagged"))
    seen = warm_up(3, 0)
    made = correction(model, data=seen)
    found = made.at(np.zeros((3, 3)), [3600.0, 7200.0, 1e6])
    assert found.valid.tolist() == [True, True, False]
    truth = np.column_stack([seen.sel(time=[3600.0, 7200.0])[name].values for name in DOF[:3]])
    assert np.abs(found.offset[:2] + truth).max() < 0.5 * np.abs(truth).max()
    hot = seen.assign_coords(temperature=seen["temperature"] + 0.005 * seen["time"])
    assert not correction(model, data=hot).at(np.zeros((1, 3)), 3600.0).valid[0]
    with raises("correction.temperatures.missing"):
        correction(model)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda ds: ds.assign_attrs(schema="errormotion.raw.other/1"), "schema.other"),
        (lambda ds: ds.assign_attrs(component="beam"), "correction.errors.of_beams"),
        (lambda ds: ds.assign_attrs(frame="artefact"), "correction.frame.other"),
        (lambda ds: ds.drop_vars("y"), "correction.coordinate.ambiguous"),
        (lambda ds: ds.rename(position="angle"), "correction.dims.other"),
        (lambda ds: ds.assign({name: ds[name] * np.nan for name in DOF}), "correction.no_errors"),
        (lambda ds: ds.assign_attrs(chain="bed-X"), "correction.chain.form"),
    ],
)
def test_errors_without_correction_are_reported(change: Callable[[xr.Dataset], xr.Dataset], code: str) -> None:
    machine = VirtualMachine("cframe", 6)
    with raises(code):
        correction(change(machine.truth_axis("Y", np.linspace(-0.2, 0.2, 9))))


@pytest.mark.parametrize(
    ("positions", "time"),
    [
        (np.zeros(3), None),
        (np.full((1, 3), np.nan), None),
        (np.zeros((2, 3)), [1.0, 2.0, 3.0]),
        (np.zeros((1, 3)), np.nan),
    ],
)
def test_invalid_points_are_an_error(positions: np.ndarray, time: object) -> None:
    machine = VirtualMachine("cframe", 6)
    made = correction(machine.truth_axis("Y", np.linspace(-0.2, 0.2, 9)))
    with pytest.raises(DatasetError, match="expected"):
        made.at(positions, time)  # type: ignore[arg-type]


def test_positions_without_errors_are_interpolated_and_reported() -> None:
    machine = VirtualMachine("cframe", 6)
    ds = machine.volumetric_truth(grid(machine, 5))
    lost = ds.assign({name: ds[name].where(ds["target_index"] % 31 != 5) for name in DOF})
    made = correction(lost)
    assert any("4 of 125 positions have no known errors" in note for note in made.notes)
    asked = places(machine, 50) * 0.8
    assert np.isfinite(made.at(asked).offset).all()
    assert np.abs(made.at(asked).offset - correction(ds).at(asked).offset).max() < 3e-6


def test_many_points_are_fast() -> None:
    """200 000 points of a volume take less than one second of processor time; ten seconds are allowed here."""
    machine = VirtualMachine("gantry", 3)
    made = correction(machine.volumetric_truth(grid(machine, 11)))
    asked = places(machine, 200_000)
    made.at(asked[:100])
    began = clock.process_time()
    made.at(asked)
    assert clock.process_time() - began < 10.0
