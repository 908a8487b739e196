"""Pieces on the table of the gantry: positions, and scans by the profiler."""

import numpy as np
import pytest
from coded import raises

from errormotion.methods.crossbeam_scan import simulation
from errormotion.twin import VirtualMachine
from errormotion.twin.artefacts.pieces import circular_pocket, swept
from errormotion.twin.sensors.profiler import Disturbances, Profiler
from errormotion.twin.table import default_positions, set_table

PERFECT = Profiler(80, 0.4e-3, disturbances=Disturbances.none())


@pytest.fixture
def gantry() -> VirtualMachine:
    return VirtualMachine("gantry", seed=3)


def along(y: np.ndarray, z: float = 0.0) -> np.ndarray:
    places = np.zeros((y.size, 3))
    places[:, 1], places[:, 2] = y, z
    return places


def test_eight_artefacts_fit_the_gantry() -> None:
    assert default_positions((-0.9, 0.9)) == pytest.approx(-0.7 + 0.2 * np.arange(8))
    assert default_positions((0.0, 0.5)) == [0.2]


def test_lines_belong_to_the_piece_below_them(gantry: VirtualMachine) -> None:
    table = set_table(gantry.crossbeam, 3, [0.3, 0.1])
    y = np.arange(0.0, 0.5, 1e-3)
    runs = list(table.runs(y))
    assert [target and target.position for _, target in runs] == [None, 0.1, None, 0.3, None]
    assert np.concatenate([np.arange(run.start, run.stop) for run, _ in runs]).tolist() == list(range(y.size))
    for run, target in runs:
        if target is not None:  # everything that is seen of it lies within
            assert y[run][[0, -1]] == pytest.approx([target.position - 0.033, target.position + 0.033], abs=1.1e-3)
            edges = table.scan(target, PERFECT, np.zeros(2), along(y[run][[0, -1]]), (0,))
            assert np.isnan(edges).all()


def test_a_scan_at_rest_in_time_is_that_of_the_raw_dataset(gantry: VirtualMachine) -> None:
    raw = simulation.raw_scans(gantry, [0.0, 5000.0], [0.1], seed=1, profiler=PERFECT, profiles=40, feed=1e-3)
    table = set_table(gantry.crossbeam, 3, [0.1])
    for cycle, t in enumerate((0.0, 5000.0)):
        y = 0.1 + raw.y.values[cycle, 0]
        heights = table.scan(table.targets[0], PERFECT, np.full(40, t), along(y), (0,))
        assert heights == pytest.approx(raw.height.values[cycle, 0], abs=1e-9, nan_ok=True)  # float32 of 4 mm: 0.25 nm


def test_each_line_has_the_error_at_its_time(gantry: VirtualMachine) -> None:
    table = set_table(gantry.crossbeam, 3, [0.1])
    y, t = np.linspace(0.08, 0.12, 5), np.array([0.0, 600.0, 1200.0, 1800.0, 2400.0])
    together = table.scan(table.targets[0], PERFECT, t, along(y), (0,))
    for k in range(5):  # one line by itself is the same line
        alone = table.scan(table.targets[0], PERFECT, t[k : k + 1], along(y[k : k + 1]), (0,))
        assert alone.shape == (1, 80)
        assert alone[0] == pytest.approx(together[k], abs=1e-12, nan_ok=True)


def test_the_pocket_is_where_the_cold_machine_cut_it(gantry: VirtualMachine) -> None:
    pocket = circular_pocket()
    y, lifts = np.linspace(-15e-3, 15e-3, 31), np.array([0.166, 0.182])
    table = set_table(gantry.crossbeam, 3, [], pocket=0.25)
    for lift in lifts:
        heights = PERFECT.scan(pocket, gantry.crossbeam.pocket_lines(y, lift), key=(0,))
        seen = table.scan(table.targets[0], PERFECT, np.zeros(31), along(0.25 + y, lift), (0,))
        assert seen == pytest.approx(heights, abs=1e-12, nan_ok=True)
        assert np.isfinite(seen).mean() > 0.5


def test_noise_depends_on_the_key(gantry: VirtualMachine) -> None:
    table = set_table(gantry.crossbeam, 3, [0.1])
    noisy = Profiler(80, 0.4e-3, disturbances=Disturbances.white(0.5e-6))
    y = np.linspace(0.09, 0.11, 50)
    one, same, other = (table.scan(table.targets[0], noisy, np.zeros(50), along(y), (3, k)) for k in (1, 1, 2))
    assert np.array_equal(one, same, equal_nan=True)
    assert np.nanstd(one - other) == pytest.approx(0.5e-6 * np.sqrt(2), rel=0.06)  # 4000 points: 1.1 % one sigma


def test_pieces_that_overlap_are_refused(gantry: VirtualMachine) -> None:
    with raises("virtual.pieces.too_close"):
        set_table(gantry.crossbeam, 3, [0.15, 0.1])
    assert set_table(gantry.crossbeam, 3, [0.1, 0.17]).targets[0].artefact.half_size == swept().half_size
