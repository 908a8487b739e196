"""Straightness that is read at a point of the table or of the tool: both readings from poses of the virtual machine."""

from functools import reduce
from operator import mul

import numpy as np
import pytest
from typer.testing import CliRunner

from errormotion import datasets
from errormotion.cli.app import app
from errormotion.compare import compare
from errormotion.datasets import DOF
from errormotion.errors import DatasetError
from errormotion.methods.multilateration import simulation as tracking
from errormotion.twin import VirtualMachine

POINT = np.array([0.05, -0.1, -0.2])
"""Functional point with all axes at zero, m."""
U = np.array([3e-8] * 3 + [6e-8] * 3)
ALL = [(kind, axis) for kind in ("cframe", "gantry") for axis in "XYZ"]
OTHER = {"table": "tool", "tool": "table"}


def read(machine, axis, place, *, stated=True, sign=1, seed=1):
    """Return the errors of an axis, read at a point of the table or of the tool.

    The displacement of a point of the tool is that of the tool in table coordinates. A sensor at a point of the table
    reads the displacement of this point in tool coordinates, with the opposite sign.
    """
    chain, motion = machine.geometry.machine, machine.geometry.motions[axis]
    k = "XYZ".index(axis)
    low, high = machine.description.travel[axis]
    q = np.linspace(low, high, 9)
    commands = np.zeros((q.size, len(chain.axis_names)))
    commands[:, chain.axis_names.index(axis)] = q
    nothing = np.zeros((q.size, 6))
    actual = reduce(
        mul,
        (
            joint.actual(
                commands[:, chain.axis_names.index(joint.name)], motion(q) if joint.name == axis else nothing, nothing
            )
            for joint in chain.joints
        ),
    )
    nominal = chain.nominal_pose(commands)
    if place == "tool":
        shown = actual.apply(POINT) - nominal.apply(POINT)
    else:
        shown = nominal.inv().apply(POINT) - actual.inv().apply(POINT)
    E = np.concatenate([shown, (actual * nominal.inv()).rotation.as_rotvec()], axis=1)
    # the zero of an instrument is arbitrary, and so is the line of a straightness
    E -= E[4]
    E[:, [j for j in range(3) if j != k]] += np.linspace(-1e-5, 2e-5, q.size)[:, None]
    E = E + U * np.random.default_rng(seed).normal(size=E.shape)
    return datasets.build_errors(
        E, np.tile(np.diag(U**2), (q.size, 1, 1)), dims=("position",), coords={axis.lower(): ("position", q)},
        component=axis, machine="M", frame="machine", functional_point=POINT, reference="r", method=place,
        method_version="1", provenance={}, measured={"straightness_reference": place} if stated else {},
    )  # fmt: skip


def volume(machine, axis="X"):
    """Return the errors of the tool at targets, many of them along one axis, with the chain of the machine."""
    truth = machine.volumetric_truth(tracking.target_grid(machine, [14 if each == axis else 4 for each in "XYZ"]))
    truth["covariance"] = truth["covariance"] + np.diag((0.3 * U) ** 2)
    noise = 0.3 * U * np.random.default_rng(5).normal(size=(truth.sizes["target"], 6))
    truth = truth.assign({name: truth[name] + noise[:, k] for k, name in enumerate(DOF)})
    return truth.assign_attrs(machine="M", chain=machine.chain, method="volume")


def restated(ds, place):
    """Return the dataset with another statement about its straightness; None: without it."""
    attrs = {name: value for name, value in ds.attrs.items() if name != "straightness_reference"}
    return ds.drop_attrs(deep=False).assign_attrs(attrs | ({"straightness_reference": place} if place else {}))


@pytest.mark.parametrize(("kind", "axis"), ALL)
def test_readings_at_table_and_tool_are_one_motion(kind, axis):
    machine = VirtualMachine(kind, seed=2)
    at_table, at_tool = read(machine, axis, "table"), read(machine, axis, "tool", seed=2)
    found = compare({"table": at_table, "tool": at_tool}, causes=False)
    assert found["p"].item() > 1e-3
    assert any("'tool': straightness read at a point of the tool" in note for note in found.attrs["notes"])
    unaware = compare({"table": at_table, "tool": restated(at_tool, "table")}, causes=False)
    assert unaware["p"].item() < 1e-9
    size = np.nanmax(np.abs(unaware["difference"].values[0, :, :3]))
    assert size > 1e-6  # many times the uncertainty


@pytest.mark.parametrize(("kind", "axis"), ALL)
@pytest.mark.parametrize("place", ["table", "tool"])
def test_an_axis_agrees_with_the_volume_wherever_its_straightness_was_read(kind, axis, place):
    machine = VirtualMachine(kind, seed=3)
    ds, targets = read(machine, axis, place), volume(machine, axis)
    assert compare({"axis": ds, "volume": targets}, causes=False)["p"].item() > 1e-3
    assert compare({"axis": restated(ds, OTHER[place]), "volume": targets}, causes=False)["p"].item() < 1e-6


def test_an_unknown_place_is_noted_with_the_size_of_its_effect_and_found_as_the_cause():
    machine = VirtualMachine("cframe", seed=3)
    targets = volume(machine)
    silent = restated(read(machine, "X", "tool"), None)
    found = compare({"axis": silent, "volume": targets})
    (note,) = (note for note in found.attrs["notes"] if "straightness_reference" in note)
    assert "'axis': where its straightness was read is unknown" in note
    assert "It is compared as read at a point of the table" in note
    R = silent.em.twist().values[:, 4:] - silent.em.twist().values[0, 4:]
    size = np.abs(silent["x"].values[:, None] * R).max()
    assert f"differs by up to {1e6 * size:.2g} um" in note
    assert found["cause"].values[0, 0] == "straightness of 'axis' read at a point of the tool"
    assert found["cause_p"].values[0, 0] > 1e-3


def test_two_unknown_places_are_compared_as_equal_with_a_note_each():
    machine = VirtualMachine("gantry", seed=3)
    one, other = (restated(read(machine, "Y", "tool", seed=k), None) for k in (1, 2))
    found = compare({"one": one, "other": other}, causes=False)
    assert found["p"].item() > 1e-3
    assert sum("as read like that of the others" in note for note in found.attrs["notes"]) == 2


def test_without_rotations_a_straightness_at_the_other_point_is_unknown():
    machine = VirtualMachine("cframe", seed=3)
    ds = read(machine, "X", "tool")
    blind = ds.assign({name: np.nan * ds[name] for name in DOF[3:]}).copy(deep=True)
    blind["covariance"].values[:, 3:] = np.nan
    blind["covariance"].values[:, :, 3:] = np.nan
    found = compare({"axis": blind, "volume": volume(machine)}, at=POINT, causes=False)
    assert found["dof"].values.tolist() == ["EX"]
    assert any("Unknown after it" in note and "EY, EZ" in note for note in found.attrs["notes"])


def test_the_attribute_is_carried_from_raw_data_and_checked():
    from errormotion.methods.linear_positioning import LinearPositioning

    settings = LinearPositioning.Settings(freedoms=("EX", "EY"))
    raw, _ = LinearPositioning().simulate(settings, seed=1)
    found = LinearPositioning().identify(raw.assign_attrs(straightness_reference="tool"), settings)
    assert found.attrs["straightness_reference"] == "tool"
    assert "straightness_reference" not in LinearPositioning().identify(raw, settings).attrs
    stated = settings.model_copy(update={"straightness_reference": "table"})
    assert LinearPositioning().identify(raw, stated).attrs["straightness_reference"] == "table"
    with_both = LinearPositioning().identify(raw.assign_attrs(straightness_reference="tool"), stated)
    assert with_both.attrs["straightness_reference"] == "tool"  # the data precede the settings
    with pytest.raises(DatasetError, match="attribute 'straightness_reference': expected table or tool; found 'bed'"):
        datasets.validate(raw.assign_attrs(straightness_reference="bed"))
    errors = read(VirtualMachine("cframe", seed=1), "X", "tool")
    with pytest.raises(DatasetError, match="attribute 'straightness_reference': expected table or tool; found 3"):
        datasets.validate(errors.assign_attrs(straightness_reference=3))


def test_the_command_line_states_the_place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    machine = VirtualMachine("cframe", seed=3)
    datasets.save(restated(read(machine, "X", "tool"), None), "axis.nc")
    datasets.save(volume(machine), "volume.nc")
    command = ["compare", "axis.nc", "volume.nc", "--straightness"]
    assert "agree within their uncertainties" in CliRunner().invoke(app, [*command, "axis=tool"]).stdout
    refused = CliRunner().invoke(app, [*command, "axis=bed"])
    assert "--straightness axis=bed: expected NAME=table or NAME=tool" in refused.stderr
