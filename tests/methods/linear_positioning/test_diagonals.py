"""Diagonals of a volume after ISO 230-6: squareness and its sign, effects that cancel, coverage, and measurement."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from axis_doubles import Bench
from coded import raises

from errormotion import datasets
from errormotion.errors import DatasetError
from errormotion.instruments import simulators
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.interferometer.attocube_ids import AttocubeIds
from errormotion.methods.linear_positioning import LinearPositioning, LinearPositioningSettings
from errormotion.methods.linear_positioning.diagonals import lines as geometry
from errormotion.methods.linear_positioning.report import chapters
from errormotion.report.document import Source
from errormotion.twin import VirtualMachine

METHOD = LinearPositioning()
FACES = ("PP0", "NP0", "0PP", "0NP", "P0P", "N0P")
BODIES = ("PPP", "NPP", "PNP", "NNP")


def along(names, **settings):
    return LinearPositioningSettings(
        **{"diagonals": {"names": names}, "count": 5, "runs": 4, "trials": 200, **settings}
    )


def exact(machine, settings):
    """Return readings without any scatter on a machine, by exact geometry."""
    raw = METHOD.expected(settings).drop_vars(["reading_scatter", "run_drift"])
    points = raw["stop_point"].values
    actual = points + machine.geometry.twist(points)[..., :3]
    way = np.linalg.norm(actual - actual[:, :1], axis=-1)
    nominal = np.linalg.norm(points - points[:, :1], axis=-1)
    shape = raw["diagonal_deviation"].shape
    values = np.broadcast_to((way - nominal)[:, None, None, :], shape)
    noise = 1e-12 * np.random.default_rng(0).normal(size=shape)
    return raw.assign(
        diagonal_deviation=raw["diagonal_deviation"].copy(data=values + noise),
        length_uncertainty=0.0 * raw["length_uncertainty"],
        alignment_uncertainty=0.0 * raw["alignment_uncertainty"],
    )


def with_errors(kind, locations, slope=0.0):
    """Return a machine with these squarenesses and a linear positioning error of each axis, and no other error."""
    machine = VirtualMachine(kind, seed=1)
    motions = {}
    for k, (axis, motion) in enumerate(machine.geometry.motions.items()):
        slopes = np.zeros(6)
        slopes["XYZ".index(axis)] = slope * (k + 1)
        motions[axis] = replace(motion, sine=0.0 * motion.sine, cosine=0.0 * motion.cosine, slope=slopes)
    machine.geometry = replace(machine.geometry, motions=motions, locations=locations)
    return machine


@pytest.mark.parametrize("kind", ["gantry", "cframe"])
def test_squareness_is_that_of_the_machine_for_any_scale_of_the_axes(kind):
    true = {"EC0Y": 40e-6, "EA0Z": -25e-6, "EB0Z": 15e-6}
    settings = along(FACES, start=(0.1, 0.2, 0.15))
    errors = METHOD.identify(exact(with_errors(kind, true, slope=30e-6), settings), settings)
    found = dict(zip(errors["squareness_of"].values, errors["squareness"].values, strict=True))
    assert found == pytest.approx(true, abs=1e-8)  # second order: 40e-6 of 40e-6, and 1e-12 m of scatter


def test_a_reversed_diagonal_shows_the_same_squareness():
    machine = with_errors("gantry", {"EC0Y": 40e-6, "EA0Z": 0.0, "EB0Z": 0.0})
    settings = along(("PP0", "PN0"))
    errors = METHOD.identify(exact(machine, settings), settings)
    assert float(errors["squareness"][0]) == pytest.approx(40e-6, abs=1e-8)


def test_body_diagonals_do_not_separate_scale_and_squareness():
    """Two machines with exchanged scales of two axes have the same four body diagonals."""
    settings = along(BODIES, diagonals={"names": BODIES, "volume": ((0.0, 0.4), (0.0, 0.4), (0.0, 0.3))})
    seen = []
    for slopes in ((30e-6, 0.0), (0.0, 30e-6)):
        machine = with_errors("gantry", {"EC0Y": 0.0, "EA0Z": 0.0, "EB0Z": 0.0})
        for axis, slope in zip("XY", slopes, strict=True):
            machine.geometry.motions[axis].slope["XY".index(axis)] = slope
        seen.append(METHOD.identify(exact(machine, settings), settings))
    np.testing.assert_allclose(seen[0]["deviation"], seen[1]["deviation"], atol=1e-9)
    assert seen[0].sizes["squareness_of"] == 0
    assert any("do not separate" in note for note in seen[0].em.notes)


@pytest.mark.slow
def test_coverage_of_deviations_squareness_and_figures():
    """48 machines: coverage of 95 % intervals; with n = 8 runs a known drift is stated larger by 1.21."""
    settings = along(("PP0", "NP0", "P0P", "N0P", "PPP"), runs=8)
    inside, square, largest = [], [], []
    for seed in range(48):
        raw, true = METHOD.simulate(settings, seed)
        errors = METHOD.identify(raw, settings)
        u = np.sqrt(errors["deviation_variance"].values)
        inside.append(np.abs(errors["deviation"].values - true["deviation"].values) < 2.0 * u)
        u = np.sqrt(np.diagonal(errors["squareness_covariance"].values))
        square.append((errors["squareness"].values - true["squareness"].values) / u)
        exact_e = np.ptp(np.concatenate([true["deviation"] + 0.75e-6, true["deviation"] - 0.75e-6], axis=1), axis=1)
        E = {each.name: each for each in METHOD.figures(errors)}
        largest.append(
            [
                abs(E[f"E of {name} (ISO 230-6)"].value - value) < E[f"E of {name} (ISO 230-6)"].expanded_uncertainty
                for name, value in zip(errors["diagonal"].values, exact_e, strict=True)
            ]
        )
    assert 0.92 < np.mean(inside) < 0.995
    assert np.mean(np.abs(square) < 2.0) > 0.92
    assert 0.7 < np.std(square) < 1.05  # 1 / 1.21 = 0.83
    assert np.mean(largest) > 0.92


def test_the_scale_of_the_instrument_is_shared_and_has_no_effect_on_squareness():
    settings = along(FACES)
    errors = METHOD.identify(METHOD.simulate(settings, 2)[0], settings)
    k = list(errors["source"].values).index("scale of the lengths")
    assert (np.abs(errors["deviation_influence"].values[k, :, -1]) > 1e-7).all()
    assert np.abs(errors["squareness_influence"].values[:, k]).max() < 1e-12
    figure = next(each for each in METHOD.figures(errors) if "EC0Y" in each.name)
    shared = sum(value**2 for value in figure.influence.values())
    assert 0.0 < shared <= (figure.expanded_uncertainty / 2.0) ** 2


def test_stops_lie_on_the_diagonal_and_programs_stop_for_the_instrument():
    settings = along(("NP0", "PPP"), start=(0.0, 0.0, 0.1), overrun=0.001)
    (face, _), places = geometry.lines(settings), geometry.distances(settings)
    assert face.start == pytest.approx([0.5, 0.0, 0.1])
    assert face.unit == pytest.approx([-5 / np.sqrt(41), 4 / np.sqrt(41), 0.0])
    assert face.length == pytest.approx(np.hypot(0.5, 0.4))
    assert ((places > 0.0) & (places < face.length + 0.1)).all()
    text = METHOD.programs(settings)["diagonals.nc"]
    assert text.count("M0") == 2
    assert text.count("G4 P4.000") == 2 * settings.runs * 2 * settings.count
    steps = METHOD.motions(settings)
    assert sum(np.isnan(step.feed) and step.place is not None for step in steps) == 2
    note = METHOD.plan(settings).em.notes[-1]
    assert "2 diagonals with 5 stops" in note


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"names": ("PPP", "NNN")}, "each diagonal once"),
        ({"names": ("P00",)}, "three letters"),
        ({"names": ("PX0",)}, "three letters"),
        ({"names": ("PP0",), "channels": {"NP0": "a"}}, "channels: expected diagonals among PP0"),
        ({"volume": ((0.5, 0.0), (0.0, 0.4), (0.0, 0.3))}, "lower end of X first"),
    ],
)
def test_settings_without_valid_diagonals_are_refused(wrong, text):
    with pytest.raises(ValueError, match=text):
        LinearPositioningSettings(diagonals=wrong)


def test_positions_off_a_line_are_refused():
    settings = along(("PP0", "NP0"))
    raw, _ = METHOD.simulate(settings, 0)
    beside = raw.copy(deep=True)
    beside["stop_point"][0, 2, 0] += 1e-4
    with raises("diagonal.stops.no_line"):
        METHOD.identify(beside, settings)
    twice = raw.assign_coords(diagonal=["PP0", "PP0"])
    with raises("diagonal.names"):
        METHOD.identify(twice, settings)
    with pytest.raises(DatasetError, match="stop_point"):
        METHOD.identify(raw.drop_vars("stop_point"), settings)


def test_the_report_shows_figures_squareness_and_a_graph_of_each_diagonal():
    settings = along(("PP0", "NP0", "PPP"))
    raw, _ = METHOD.simulate(settings, 1)
    errors = METHOD.identify(raw, settings)
    (part,) = chapters(Source(errors, raw=raw, key="test"))
    titles = [section.title for section in part.sections]
    assert titles[:3] == ["Figures of ISO 230-6", "Squareness", "Diagonal PP0"]
    assert [figure.label for figure in part.key_figures][-1] == "squareness EC0Y by diagonals"


# ---------------------------------------------------------------------- measuring

WIRE = "sim://cframe/ids?seed=7&noise=0&running=1&beam1=4,3,0&beam2=-4,3,0"
MEASURED = along(
    ("PP0", "NP0"),
    diagonals={
        "names": ("PP0", "NP0"),
        "volume": ((-0.2, 0.2), (-0.15, 0.15), (0.1, 0.2)),
        "channels": {"PP0": "axis1", "NP0": "axis2"},
    },
    start=(0.0, 0.0, 0.1),
    average=1,
    runs=4,
)


def measured(settings, address, done=None, asked=None):
    with (
        AttocubeIds(address, AttocubeIds.Settings(axes=(1, 2), timeout=2.0, after_break="clear")) as laser,
        VirtualController("sim://cframe/controller?seed=7", VirtualController.Settings(arm=True)) as control,
    ):
        bench = Bench(controller=control, interferometer=laser)
        bench.ask = (asked if asked is not None else []).append
        parts = list(METHOD.acquire(bench, settings, inputs={}, done=done))
    raw = xr.concat(
        parts, dim="diagonal", data_vars="minimal", coords="minimal", compat="override", combine_attrs="override"
    )
    raw.attrs.pop("invalid")
    datasets.validate(raw)
    return raw


def test_an_interferometer_finds_the_errors_along_the_diagonals():
    asked = []
    raw = measured(MEASURED, WIRE, asked=asked)
    assert [text.partition(",")[0] for text in asked] == [
        f"Align the instrument to diagonal {n}" for n in ("PP0", "NP0")
    ]
    errors = METHOD.identify(
        raw,
        MEASURED.model_copy(
            update={"uncertainty": MEASURED.uncertainty.model_copy(update={"length": 0.0, "alignment": 0.0})}
        ),
    )
    machine = simulators.world("cframe", 7).machine
    points = raw["stop_point"].values
    unit = np.array([[0.8, 0.6, 0.0], [-0.8, 0.6, 0.0]])
    displaced = np.einsum("dsi,di->ds", machine.geometry.twist(points)[..., :3], unit)
    true = displaced - displaced[:, :1]
    assert np.ptp(true) > 1e-6
    np.testing.assert_allclose(errors["deviation"], true, atol=1e-9)  # 1 um beside the line, and whole picometres


def test_a_broken_beam_affects_one_run_and_an_interrupted_test_continues_with_the_next_diagonal():
    raw = measured(MEASURED, f"{WIRE}&fault=beam_broken&fault_at=15&fault_for=1&broken=1")
    missing = np.isnan(raw["diagonal_deviation"].values)
    assert missing[0, 1].any()
    assert not missing[0, [0, 2, 3]].any()
    rest = measured(MEASURED, WIRE, done=raw.isel(diagonal=[0]))
    assert rest["diagonal"].values.tolist() == ["NP0"]


def test_a_diagonal_needs_a_channel():
    wrong = MEASURED.model_copy(update={"diagonals": MEASURED.diagonals.model_copy(update={"channels": {}})})
    with raises("position.channel.unknown"):
        measured(wrong, WIRE)
