"""Compensation tables: written, read like a control, applied to the virtual machine, and measured again."""

import re
import sys
from collections.abc import Mapping
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import table_readers
import xarray as xr
from coded import raises

from errormotion.compensation.tables import (
    AxisTable,
    Exported,
    TableSettings,
    Written,
    axis_table,
    export,
    get,
    registry,
)
from errormotion.compensation.tables.formats.generic import GenericTable
from errormotion.datasets.schemas import DOF
from errormotion.errors import DatasetError, PluginError
from errormotion.twin import VirtualMachine

FORMATS = ("linuxcnc", "siemens", "heidenhain", "fanuc", "generic")
BOTH_DIRECTIONS = ("linuxcnc", "heidenhain", "generic")
NOISE = 0.3e-6
REVERSAL = 3e-6


@pytest.fixture(scope="module")
def machine() -> VirtualMachine:
    return VirtualMachine("gantry", 4)


def measured(machine: VirtualMachine, seed: int | None = None, count: int = 33, reversal: float = 0.0) -> xr.Dataset:
    """Return a measurement of Y, with noise if a seed is given."""
    low, high = machine.travel["Y"]
    ds = machine.truth_axis("Y", np.linspace(low, high, count)).load()
    if seed is not None:
        rng = np.random.default_rng(seed)
        for name in DOF[:3]:
            ds[name] = ds[name] + NOISE * rng.normal(size=count)
        C = np.zeros((count, 6, 6))
        C[:, range(3), range(3)] = NOISE**2
        ds["covariance"] = (ds["covariance"].dims, C)
    if reversal:
        ds = ds.assign(reversal=(("freedom", "position"), np.full((2, count), reversal)))
        ds = ds.assign_coords(freedom=["EYY", "EZY"])
    return ds


def texts(exported: Exported) -> Mapping[str, str]:
    return {name: content for name, content in exported.files.items() if isinstance(content, str)}


def remaining(
    machine: VirtualMachine, exported: Exported, form: str, component: str = "Y", reversal: float = 0.0
) -> np.ndarray:
    """Return the true error with this table in the control, at 101 commands in both directions, (2, 101), m."""
    control = getattr(table_readers, form)(texts(exported))
    y = np.linspace(*machine.travel["Y"], 101)
    found = []
    for direction in (1.0, -1.0):
        move = control(y, np.full(y.size, direction))
        along = y + (move if component == "Y" else 0.0)  # where the axis itself is, by its own scale
        own = machine.geometry.motions["Y"](along)[:, DOF.index(f"E{component}")] + direction * reversal / 2
        found.append(move + own)
    return np.array(found)


@pytest.mark.parametrize("form", FORMATS)
def test_the_remaining_error_is_within_the_stated_uncertainty_and_the_error_of_the_table(
    machine: VirtualMachine, form: str
) -> None:
    """20 measurements of one axis; the true error is determined with each table."""
    step = None if form == "linuxcnc" else 0.05
    inside, worst, before = [], [], np.abs(machine.geometry.motions["Y"](np.linspace(*machine.travel["Y"], 101))[:, 1])
    for seed in range(20):
        exported = export(axis_table(measured(machine, seed), "Y", step=step), get(form))
        left = remaining(machine, exported, form)
        factor = 1.0
        if form == "fanuc":  # its table is 0 at the reference point, whatever was measured there
            left, factor = left - left[:, [int(np.abs(np.linspace(*machine.travel["Y"], 101)).argmin())]], np.sqrt(2)
        limit = 2 * factor * exported.uncertainty + exported.interpolation
        inside.append((np.abs(left) <= limit).mean())
        worst.append(np.abs(left).max() / limit)
    assert before.max() > 8e-6
    assert np.mean(inside) > 0.95
    assert max(worst) < 2.5


@pytest.mark.parametrize("form", ["siemens", "heidenhain"])
@pytest.mark.parametrize("reversal", [0.0, REVERSAL])
def test_straightness_is_corrected_by_a_table_of_another_axis(
    machine: VirtualMachine, form: str, reversal: float
) -> None:
    exported = export(
        axis_table(measured(machine, reversal=reversal, count=201), "Y", component="Z", step=0.02), get(form)
    )
    left = remaining(machine, exported, form, "Z", reversal)
    assert np.abs(left).max() < exported.interpolation + 0.05e-6  # 0.05 um: between measured places
    assert any("sign" in remark for remark in exported.remarks)


@pytest.mark.parametrize("form", FORMATS)
def test_both_directions_are_corrected_if_the_control_distinguishes_them(machine: VirtualMachine, form: str) -> None:
    exported = export(axis_table(measured(machine, reversal=REVERSAL, count=201), "Y", step=0.02), get(form))
    left = remaining(machine, exported, form, reversal=REVERSAL)
    if form in BOTH_DIRECTIONS:
        assert np.abs(left).max() < exported.interpolation + 0.05e-6
    else:
        assert np.abs(np.ptp(left, axis=0) - REVERSAL).max() < 1e-9
        assert np.abs(left.mean(axis=0)).max() < exported.interpolation
        assert any("Half of the reversal, up to 1.50 um" in remark for remark in exported.remarks)
        assert exported.rounding >= REVERSAL / 2 - 1e-9  # what the control cannot hold is stated


@pytest.mark.parametrize("form", FORMATS)
def test_every_file_states_its_content(machine: VirtualMachine, form: str) -> None:
    ds = measured(machine, 1).assign_attrs(start="2026-11-22T08:00:00+01:00", reference_temperature=20.0)
    exported = export(axis_table(ds, "Y", step=0.05, run="run 7"), get(form))
    text = next(content for name, content in texts(exported).items() if not name.endswith(".cma")).lower()
    for stated in (
        f"machine: {machine.name}", "2026-11-22t08:00:00+01:00", "run 7", "method: twin 1", "sign", "unit: ",
        "20.00 degc", "uncertainty of the correction",
    ):  # fmt: skip
        assert stated.lower() in text, stated
    assert all(ord(letter) < 128 for letter in text)


def test_a_name_cannot_become_a_line_of_the_table(machine: VirtualMachine) -> None:
    ds = measured(machine).assign_attrs(machine="x\n0 0 0\r$AA_ENC_COMP[0,0,Y1]=9/../../etc\u00e9%")
    for form in FORMATS:
        exported = export(axis_table(ds, "Y", step=0.05), get(form))
        assert all("/" not in name and name.isascii() for name in exported.files)
        control = getattr(table_readers, form)(texts(exported))
        assert np.abs(control(np.array([0.0, 1.0]), np.ones(2))).max() < 1e-4
        assert not any(
            line.startswith(("0 0 0", "$AA_ENC_COMP[0,0,Y1]=9"))
            for line in "\n".join(texts(exported).values()).splitlines()
        )


def test_both_file_types_of_linuxcnc_are_equivalent(machine: VirtualMachine) -> None:
    table = axis_table(measured(machine, reversal=REVERSAL), "Y")
    form = get("linuxcnc")
    y, d = np.linspace(-0.9, 0.9, 50), np.where(np.arange(50) % 2, 1.0, -1.0)
    trims, reached = (
        table_readers.linuxcnc(texts(export(table, form, form.Settings(type=k))), k)(y, d) for k in (1, 0)
    )
    assert np.abs(trims - reached).max() < 1e-9


def test_siemens_table_as_a_part_program(machine: VirtualMachine) -> None:
    table, written = axis_table(measured(machine), "Y", component="Z", step=0.1), get("siemens")
    file, program = texts(export(table, written)), texts(export(table, written, written.Settings(program=True)))
    ((_, ini),), ((name, mpf),) = file.items(), program.items()
    assert name.endswith(".MPF")
    lines = mpf.splitlines()
    assert lines[0] == f"%_N_{name.removesuffix('.MPF')}_MPF"
    assert re.fullmatch(r"%_N_[A-Z0-9_]{1,24}_MPF", lines[0])
    assert lines[1] == ";$PATH=/_N_MPF_DIR"
    assert lines[-1] == "M30"
    assert lines[2:-1] == ini.splitlines()[2:-1]


def test_signs_from_memory_can_be_reversed(machine: VirtualMachine) -> None:
    y, d = np.linspace(-0.8, 0.8, 20), np.ones(20)
    for form, component in (("siemens", "Z"), ("heidenhain", "Y"), ("fanuc", "Y")):
        table, written = axis_table(measured(machine), "Y", component=component, step=0.05), get(form)
        turned = export(table, written, written.Settings(inverted=True))
        plain = export(table, written)
        one, other = (getattr(table_readers, form)(texts(each))(y, d) for each in (plain, turned))
        assert np.abs(one).max() > 2e-6
        assert np.abs(one + other).max() < 1e-12
        assert turned.rounding == plain.rounding


# ---------------------------------------------------------------------- what a control would refuse


def steep(machine: VirtualMachine) -> xr.Dataset:
    ds = measured(machine)
    return ds.assign(EY=ds["EY"] + 0.03 * ds["y"])


@pytest.mark.parametrize(
    ("form", "step", "settings", "component", "message"),
    [
        ("linuxcnc", 0.005, {}, "Y", "LinuxCNC accepts at most 256 points; this table has 361"),
        ("linuxcnc", None, {}, "Z", "no table of Z over Y"),
        ("siemens", 0.005, {"most_points": 200}, "Y", "at most 200 points; this table has 361"),
        ("heidenhain", 0.005, {}, "Y", "at most 256 points"),
        ("fanuc", 0.005, {}, "Y", "at most 128 points per axis"),
        ("fanuc", 0.05, {"first_number": 1000}, "Y", "numbers up to 1023; this table has 36 from 1001"),
        ("fanuc", 0.05, {}, "X", "no table of X over Y"),
    ],
)  # fmt: skip
def test_a_table_that_the_control_would_refuse_is_not_written(
    machine: VirtualMachine, form: str, step: float | None, settings: dict[str, int], component: str, message: str
) -> None:
    written = get(form)
    with pytest.raises(DatasetError, match=message):
        export(
            axis_table(measured(machine), "Y", component=component, step=step), written, written.Settings(**settings)
        )


def test_fanuc_rejects_values_out_of_range(machine: VirtualMachine) -> None:
    with raises("table.step.too_large"):
        export(axis_table(steep(machine), "Y", step=0.05), get("fanuc"))
    with raises("table.reference.no_point"):
        export(axis_table(measured(machine, count=32), "Y"), get("fanuc"))


def test_uneven_positions_require_a_step(machine: VirtualMachine) -> None:
    ds = measured(machine).isel(position=[0, 1, 3, 7, 16, 20, 32])
    for form in ("siemens", "fanuc"):
        with raises("table.points.not_equidistant"):
            export(axis_table(ds, "Y"), get(form))
    assert export(axis_table(ds, "Y"), get("linuxcnc")).points == 7


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ({"axis": "A"}, "table.axis.unknown"),
        ({"axis": "Y", "component": "C"}, "table.axis.unknown"),
        ({"axis": "X"}, "table.axis.no_positions"),
        ({"axis": "Y", "step": 0.0}, "table.distance.not_positive"),
        ({"axis": "Y", "step": np.nan}, "table.distance.not_positive"),
        ({"axis": "Y", "step": 5.0}, "table.distance.too_large"),
        ({"axis": "Y", "step": 1e-6}, "table.points.too_many"),
    ],
)
def test_a_choice_without_table_is_an_error(machine: VirtualMachine, arguments: dict[str, object], code: str) -> None:
    with raises(code):
        axis_table(measured(machine), **arguments)  # type: ignore[arg-type]


def test_a_freedom_that_was_not_measured_has_no_table(machine: VirtualMachine) -> None:
    ds = measured(machine)
    alone = ds.assign({name: ds[name] * np.nan for name in DOF if name != "EY"})
    assert axis_table(alone, "Y").positions.size == 33
    with raises("table.freedom.unknown"):
        axis_table(alone, "Y", component="Z")


def test_the_table_of_an_axis_at_a_position_follows_from_a_volume(machine: VirtualMachine) -> None:
    x, y, z = (np.linspace(*machine.travel[axis], 9) for axis in "XYZ")
    nodes = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    table = axis_table(machine.volumetric_truth(nodes), "Y", component="X", at=[x[2], 0.0, z[5]])
    places = np.column_stack([np.full(9, x[2]), y, np.full(9, z[5])])
    assert (
        np.abs(table.forward + machine.geometry.twist(places)[:, 0]).max() < 3e-8
    )  # the nodes are 0.2 m apart and more


# ---------------------------------------------------------------------- files and foreign formats


def test_files_that_exist_are_kept(machine: VirtualMachine, tmp_path: Path) -> None:
    exported = export(axis_table(measured(machine), "Y"), get("heidenhain"))
    first = exported.save(tmp_path / "tables")
    first[1].unlink()
    before = first[0].read_bytes()
    with raises("table.file.exists"):
        exported.save(tmp_path / "tables")
    assert first[0].read_bytes() == before
    assert not first[1].exists()


def test_the_netcdf_file_contains_the_table(machine: VirtualMachine, tmp_path: Path) -> None:
    table = axis_table(measured(machine, 2, reversal=REVERSAL), "Y")
    paths = export(table, get("generic")).save(tmp_path)
    with xr.open_dataset(next(path for path in paths if path.suffix == ".nc"), engine="h5netcdf") as found:
        assert (found["offset_backward"].values == table.backward).all()
        assert found["offset_forward"].attrs["units"] == "m"
        assert "uncertainty" in found.attrs["comments"]


class Foreign(GenericTable):
    """A format of another distribution."""

    id = "foreign"
    title = "Another control"

    def write(self, table: AxisTable, settings: TableSettings) -> Written:
        return Written(
            {"table.txt": "\n".join(f"{x:.3f}" for x in table.forward)}, 0 * table.forward, 0 * table.forward
        )


class Nameless:
    """No format."""


def test_a_format_of_another_distribution_is_used(monkeypatch: pytest.MonkeyPatch, machine: VirtualMachine) -> None:
    def points() -> tuple[EntryPoint, ...]:
        here = f"{__name__}:"
        return tuple(
            EntryPoint(name, value, registry.GROUP)
            for name, value in (
                ("foreign", f"{here}Foreign"), ("wrong", f"{here}Foreign"), ("bare", f"{here}Nameless"),
                ("broken", "no_such_module:Format"), ("twice", f"{here}Foreign"), ("twice", f"{here}Nameless"),
            )
        )  # fmt: skip

    monkeypatch.setitem(sys.modules, __name__, SimpleNamespace(Foreign=Foreign, Nameless=Nameless))
    monkeypatch.setattr(registry, "_points", points)
    exported = export(axis_table(measured(machine), "Y"), get("foreign"))
    assert list(exported.files) == ["table.txt"]
    assert exported.rounding > 1e-6  # it states offsets of 0, and so is found out
    for name, message in (
        ("wrong", "has the id 'foreign'"), ("bare", "lacks id, title"), ("broken", "cannot be loaded: ModuleNotFound"),
        ("twice", "Several distributions provide"), ("foreing", "Did you mean 'foreign'"),
    ):  # fmt: skip
        with pytest.raises(PluginError, match=message):
            get(name)
