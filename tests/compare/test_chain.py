"""An axis compared with the volume: prediction by the chain, its uncertainty, and errors."""

import numpy as np
import pytest
from coded import raises
from scipy.stats import chi2, kstest
from typer.testing import CliRunner

from errormotion import datasets, plugins
from errormotion.cli.app import app
from errormotion.compare import compare
from errormotion.kinematics.machines import Machine
from errormotion.methods.multilateration import simulation as tracking
from errormotion.twin import VirtualMachine

CFRAME, GANTRY = "workpiece-X-Y-bed-Z-spindle-tool", "workpiece-bed-Y-X-Z-spindle-tool"
TRAVEL = np.array([[0.0, 0.5], [0.0, 0.4], [-0.3, 0.0]])
TOOL = np.array([0.02, -0.03, -0.12])
U = 0.4e-6
"""Standard uncertainty of the displacement of a target, m."""
U_AXIS = np.array([0.2e-6] * 3 + [0.5e-6] * 3)
ABOUT = {"machine": "M", "frame": "machine", "reference": "r", "method": "m", "method_version": "1", "provenance": {}}


def motions(rng):
    """Return smooth errors of three axes, (3, order, 6): polynomials of -1 to 1 whose coefficients fall off as n^-2."""
    return rng.normal(size=(3, 12, 6)) * np.maximum(np.arange(12), 1)[:, None] ** -2.0 * ([4e-6] * 3 + [8e-6] * 3)


def errors_of(c, axis, q):
    low, high = TRAVEL[axis]
    return np.polynomial.legendre.legvander((2 * q - low - high) / (high - low), c.shape[1] - 1) @ c[axis]


def volume(
    c, chain, rng, *, levels=(6, 6, 5), own_point=(0, 0, 0), source=None, squareness=(2e-5, -1e-5, 3e-5), **more
):
    """Return the errors of targets as a method with a free datum states them."""
    grid = [np.linspace(*each, n) for each, n in zip(TRAVEL, levels, strict=True)]
    q = np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 3)
    model = Machine(chain, {"Y": own_point})
    p = np.concatenate([errors_of(c, k, q[:, k]) for k in range(3)] + [np.tile(squareness, (len(q), 1))], axis=1)
    e = model.volumetric_error(q, p, TOOL)
    F = np.zeros((1, len(q), 6))
    F[0, :, 0] = 2e-6 * q[:, 1] if source is None else source(q)
    e = e + F[0] * rng.normal() + U * rng.normal(size=e.shape)
    place = q + TOOL
    datum = rng.normal(size=6) * [1e-5, 1e-5, 1e-5, 2e-5, 2e-5, 2e-5]
    e[:, :3] += datum[:3] + np.cross(datum[3:], place)
    e[:, 3:] = np.nan
    C = np.full((len(q), 6, 6), np.nan)
    C[:, :3, :3] = U**2 * np.eye(3) + np.einsum("si,sj->sij", F[0, :, :3], F[0, :, :3])
    return datasets.build_errors(
        e, C, dims=("target",), coords={name: ("target", q[:, k]) for k, name in enumerate("xyz")}, influence=F,
        sources=["refraction"], source_groups=["refraction"], component="tool", functional_point=TOOL,
        **ABOUT | {"measured": {"chain": chain}, "start": "2026-03-02T09:00:00+00:00"} | more,
    )  # fmt: skip


def axis(c, rng, *, y=None, point=(0, 0, 0), **more):
    """Return the errors of Y at its own functional point."""
    y = np.linspace(0.02, 0.38, 9) if y is None else y
    n = y.size
    e = errors_of(c, 1, y) + U_AXIS * rng.normal(size=(n, 6))
    return datasets.build_errors(
        e, np.tile(np.diag(U_AXIS**2), (n, 1, 1)), dims=("position",), coords={"y": ("position", y)}, component="Y",
        functional_point=point, **ABOUT | more,
    )  # fmt: skip


@pytest.mark.parametrize("chain", [CFRAME, GANTRY])
def test_the_volume_gives_the_errors_of_the_axis(chain, monkeypatch):
    monkeypatch.setitem(globals(), "U", 1e-10)
    monkeypatch.setitem(globals(), "U_AXIS", np.full(6, 1e-10))
    rng = np.random.default_rng(2)
    c, point = motions(rng), (0.1, -0.2, 0.3)
    given = {
        "axis": axis(c, rng, point=point, y=np.linspace(*TRAVEL[1], 6)),  # where the targets are
        "volume": volume(c, chain, rng, own_point=point, source=lambda q: np.zeros(len(q))),
    }
    found = compare(given, causes=False)
    assert found.sizes["dof"] == (6 if chain == GANTRY else 4)
    assert np.abs(found["value"].values).max() > 1e-6
    np.testing.assert_allclose(found["difference"].values, 0.0, atol=2e-9)


@pytest.mark.parametrize(("kind", "axis_name"), [("cframe", "X"), ("gantry", "Z")])
def test_targets_of_a_tracker_give_the_true_errors_of_the_axes(kind, axis_name):
    """The virtual machine has error motions of all orders; a machine of order 3 would leave 50 times their variance."""
    machine = VirtualMachine(kind, seed=3)
    q = tracking.target_grid(machine, (6, 6, 5))
    cls = plugins.get("methods", "multilateration")
    measured = cls().identify(tracking.raw(machine, q, seed=3), cls.Settings(parametric=False))
    k = "XYZ".index(axis_name)
    truth = machine.truth_axis(axis_name, np.linspace(q[:, k].min(), q[:, k].max(), 9))
    truth["covariance"] = truth["covariance"] + (1e-8) ** 2 * np.eye(6)
    truth = truth.assign_attrs({name: measured.attrs[name] for name in ("machine", "frame")})
    found = compare({"truth": truth, "volume": measured}, causes=False)
    assert np.abs(found["value"].values).max() > 2e-6
    assert found["p"].item() > 0.001
    assert np.nanmax(np.abs(found["en"].values)) < 1.6


@pytest.mark.slow
@pytest.mark.parametrize("chain", [CFRAME, GANTRY])
def test_an_axis_agrees_with_the_volume_of_the_same_machine(chain):
    rng, p, en, square, degrees = np.random.default_rng(1), [], [], 0.0, 0
    point = (0.1, -0.2, 0.3)
    for _ in range(20):
        c = motions(rng)
        given = {"axis": axis(c, rng, point=point), "volume": volume(c, chain, rng, own_point=point)}
        found = compare(given, causes=False)
        p.append(found["p"].item())
        square, degrees = square + found["chi2"].item(), degrees + found["degrees"].item()
        en.append(found["en"].values[np.isfinite(found["en"].values)])
    assert 0.93 <= np.mean(np.abs(en) <= 1) <= 0.98
    assert 0.01 < chi2.sf(square, degrees) < 0.99  # uncertainties that are wrong by a tenth would fail
    assert kstest(p, "uniform").pvalue > 1e-3  # the probability of a false alarm


def test_a_wrong_scale_of_the_axis_is_found():
    rng = np.random.default_rng(3)
    c = motions(rng)
    wrong = axis(c, rng)
    wrong["EY"] = wrong["EY"] + 20e-6 * wrong["y"].values
    found = compare({"axis": wrong, "volume": volume(c, CFRAME, rng)}, causes=False)
    freedoms = dict(zip(found["dof"].values.tolist(), found["curve_p"].values[0], strict=True))
    assert freedoms["EY"] < 1e-4
    assert min(p for name, p in freedoms.items() if name != "EY") > 1e-3


def test_a_warm_axis_is_compared_with_the_change_of_the_volume_at_its_time():
    rng = np.random.default_rng(4)
    cold, warm = motions(rng), motions(rng)
    before = volume(cold, GANTRY, rng, start="2026-03-02T07:00:00+00:00")
    after = volume(warm, GANTRY, rng)
    y = np.linspace(0.02, 0.38, 9)
    steps = np.array([0.0, 0.3, 1.0])[:, None, None] * errors_of(warm - cold, 1, y)
    scans = datasets.build_errors(
        steps + U_AXIS * rng.normal(size=(3, 9, 6)), np.tile(np.diag(U_AXIS**2), (3, 9, 1, 1)),
        dims=("time", "position"), coords={"time": [0.0, 3600.0, 7100.0], "y": ("position", y)}, component="Y",
        functional_point=(-0.5, 0, 0), start="2026-03-02T07:00:00+00:00", reference_interval=(0.0, 0.0),
        **ABOUT | {"frame": "carriage"},
    )  # fmt: skip
    placed = scans.assign_attrs(frame_origin=[0.5, 0.0, 0.0])
    found = compare({"scans": placed, "volume": after.em.change_from(before)}, causes=False)
    assert found["p"].item() > 0.01
    assert any("'scans' at 7100 s" in note for note in found.attrs["notes"])
    with raises("compare.reference.differs"):
        compare({"scans": placed, "volume": after})
    with raises("compare.attribute.differs"):
        compare({"scans": scans, "volume": after.em.change_from(before)})
    silent = placed.drop_attrs(deep=False).assign_attrs({k: v for k, v in placed.attrs.items() if k != "start"})
    with raises("compare.start.missing"):
        compare({"scans": silent, "volume": after.em.change_from(before)})


def test_one_interferometer_in_both_volumes_is_fully_correlated():
    rng = np.random.default_rng(5)
    c = motions(rng)
    one, other = (volume(c, GANTRY, rng, source_ids={"refraction": "cert 7"}) for _ in range(2))
    apart = volume(c, GANTRY, rng, source_ids={"refraction": "cert 8"})
    shared, free = (np.diagonal(one.em.change_from(each)["covariance"].values[-1])[0] for each in (other, apart))
    assert shared == pytest.approx(2 * U**2)
    assert free == pytest.approx(2 * U**2 + 2 * (2e-6 * 0.4) ** 2)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda a, v: (a, v.drop_attrs(deep=False).assign_attrs({k: x for k, x in v.attrs.items() if k != "chain"})),
         "compare.chain.missing"),
        (lambda a, v: (a, v.assign_attrs(chain="workpiece-bed-X-Z-tool")), "compare.chain.no_axis"),
        (lambda a, v: (a, v.assign_attrs(chain="workpiece-C-X-Y-bed-Z-tool")), "compare.targets.no_position"),
        (lambda a, v: (a, v.drop_vars("x")), "compare.targets.no_position"),
        (lambda a, v: (a.assign_coords(y=a["y"] + 3.0), v), "compare.positions.few_common"),
        (lambda a, v: (a, v.isel(target=slice(0, 27, 4))), "compare.targets.undetermined"),
        (lambda a, v: (a.drop_vars("y"), v), "compare.coordinate.missing"),
    ],
)  # fmt: skip
def test_missing_parts_are_named(change, code):
    rng = np.random.default_rng(6)
    c = motions(rng)
    a, v = change(axis(c, rng), volume(c, CFRAME, rng, levels=(3, 3, 3)))
    with raises(code):
        compare({"axis": a, "volume": v})


def test_the_command_line_states_what_the_files_do_not(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(4)
    cold, warm = motions(rng), motions(rng)
    silent = {"measured": {}}
    datasets.save(volume(cold, GANTRY, rng, start="2026-03-02T07:00:00+00:00", **silent), "cold.nc")
    datasets.save(volume(warm, GANTRY, rng, **silent), "warm.nc")
    of_axis = axis(warm - cold, rng, point=(-0.5, 0, 0), frame="carriage", reference_interval=(0.0, 0.0))
    datasets.save(of_axis, "axis.nc")

    def call(*arguments):
        return CliRunner().invoke(app, ["compare", "axis.nc", *arguments])

    change = ("--change", "volume=warm.nc,cold.nc")
    for arguments, message in (
        (change, "frame_origin, --origin"),
        (("warm.nc", "--origin", "axis=500,0,0", "--chain", GANTRY), "--change NAME=AFTER,BEFORE"),
        ((*change, "--origin", "axis=500,0,0"), "State it (--chain)"),
        (("--change", "volume=warm.nc"), "NAME=AFTER,BEFORE"),
        ((*change, "--origin", "other=1,2,3"), "expected the name of a result"),
    ):
        result = call(*arguments)
        assert result.exit_code == 1
        assert message in result.stderr
        assert "Traceback" not in result.output
    result = call(*change, "--origin", "axis=500,0,0", "--chain", GANTRY)
    assert result.exit_code == 0, result.output
    assert "agree within their uncertainties" in result.stdout
