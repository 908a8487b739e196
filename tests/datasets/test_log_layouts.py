"""Layouts of readings in the files of others: as measured, several in a row, other names of directions."""

import io
from pathlib import Path

import numpy as np
import pytest

from errormotion.datasets.importing import import_log
from errormotion.datasets.tables.mistakes import Mistakes
from errormotion.datasets.text.layout import passes, targets
from errormotion.errors import DatasetError

SCHEMA = "errormotion.raw.linear_positioning/1"
HEAD = f'schema = "{SCHEMA}"\nattributes = {{axis = "X"}}\nvalues.length_uncertainty = 0.4e-6\n'
MONITOR = 'schema = "errormotion.raw.monitor/1"\nsequence = "Position"\ncolumns.time = {column = "Error", unit = "s"}\n'
WAYS = ("forward", "backward")
SEQUENCE = (
    HEAD
    + 'sequence = "Position"\n[columns]\ntarget_position = {column = "Position", unit = "mm"}\n'
    + 'deviation.EXX = {column = "Error", unit = "um"}\n'
)
POSITIONS = [0.0, 100.0, 200.0]


def error(run: int, way: int, target: int) -> float:
    return 0.1 * target + run - 2.0 * way


def expected(runs: int = 3, ways: int = 2) -> np.ndarray:
    return np.array([[[error(r, w, t) for t in range(3)] for w in range(ways)] for r in range(runs)]) * 1e-6


def measured(runs: int, ways: int = 2, once: bool = False) -> list[tuple[float, float]]:
    """Return positions and readings in the order of measurement; ``once``: the last target is not measured again."""
    rows = []
    for run in range(runs):
        rows += [(POSITIONS[t], error(run, 0, t)) for t in range(3)]
        if ways == 2:
            rows += [(POSITIONS[t], error(run, 1, t)) for t in (range(1, -1, -1) if once else range(2, -1, -1))]
    return rows


@pytest.fixture
def imported(tmp_path: Path):
    def run(log: str | bytes, mapping: str, name: str = "log.csv"):
        (tmp_path / name).write_bytes(log if isinstance(log, bytes) else log.encode())
        (tmp_path / "map.toml").write_text(mapping)
        return import_log(tmp_path / name, tmp_path / "map.toml", tmp_path / "raw.nc", overwrite=True)

    return run


@pytest.mark.parametrize("ways", [1, 2])
def test_run_and_approach_follow_from_the_sequence_of_positions(imported, ways: int) -> None:
    log = "Position;Error\n" + "".join(f"{x};{y}\n" for x, y in measured(3, ways))
    raw = imported(log, SEQUENCE)
    found = raw["deviation"].sel(freedom="EXX").transpose("run", "approach", "target")
    np.testing.assert_allclose(found, expected(3, ways), rtol=1e-12)
    np.testing.assert_allclose(raw["target_position"], [0, 0.1, 0.2])
    assert raw["approach"].values.tolist() == ["forward", "backward"][:ways]


def test_a_last_target_that_is_measured_once_is_one_of_the_first_pass(imported) -> None:
    log = "Position;Error\n" + "".join(f"{x};{y}\n" for x, y in measured(3, once=True))
    found = imported(log, SEQUENCE)["deviation"].sel(freedom="EXX").transpose("run", "approach", "target").values
    missing = np.isnan(found)
    assert missing[:, 1, 2].all()
    assert missing.sum() == 3
    np.testing.assert_allclose(found[~missing], expected()[~missing], rtol=1e-12)


def test_a_spreadsheet_as_measured(imported) -> None:
    from openpyxl import Workbook

    book = Workbook()
    for row in [("ISO 230-2", "X"), (), ("Position", "Error"), *measured(5)]:
        book.active.append(row)
    data = io.BytesIO()
    book.save(data)
    raw = imported(data.getvalue(), SEQUENCE, "axis.xlsx")
    found = raw["deviation"].sel(freedom="EXX").transpose("run", "approach", "target")
    np.testing.assert_allclose(found, expected(5), rtol=1e-12)


def test_targets_that_are_not_visited_one_after_another_are_refused() -> None:
    mistakes = Mistakes(Path("log.csv"))
    passes(np.array([0.0, 1.0, 1.001, 2.0, 3.0, 4.0]), np.arange(2, 8), mistakes)
    with pytest.raises(DatasetError, match="line 3: sequence: the pass of lines 2 to 3 has 2 of 4 targets"):
        mistakes.raise_any()


def test_the_last_pass_may_be_interrupted() -> None:
    mistakes = Mistakes(Path("log.csv"))
    run, approach, target = passes(np.array([0.0, 1.0, 2.0, 2.0, 1.0, 0.0, 0.0]), np.arange(2, 9), mistakes)
    mistakes.raise_any()
    assert (run[-1], approach[-1], target[-1]) == ("2", "forward", "1")


def test_positions_of_a_target_differ_slightly() -> None:
    rng = np.random.default_rng(3)
    number = np.array([0, 1, 2, 3, 3, 2, 1, 0] * 5)
    assert targets(137.5 * number + rng.uniform(-0.01, 0.01, number.size)).tolist() == number.tolist()
    assert targets(np.array([5.0, 5.0])).tolist() == [0, 0]


def test_several_readings_in_a_row(imported) -> None:
    """A matrix: a row for each target, a column for each run and direction."""
    columns = [(r, w) for r in range(3) for w in range(2)]
    log = "Target;" + ";".join(f"{r + 1}{'+-'[w]}" for r, w in columns) + "\n"
    log += "".join(
        f"{x};" + ";".join(f"{error(r, w, t):.1f}" for r, w in columns) + "\n" for t, x in enumerate(POSITIONS)
    )
    entries = ",\n".join(
        f'  {{column = "{r + 1}{"+-"[w]}", unit = "um", labels = {{run = {r + 1}, approach = "{WAYS[w]}"}}}}'
        for r, w in columns
    )
    mapping = (
        HEAD
        + 'labels = {target = "Target"}\n[columns]\ntarget_position = {column = "Target", unit = "mm"}\n'
        + f"deviation.EXX = [\n{entries}\n]\n"
    )
    raw = imported(log, mapping)
    found = raw["deviation"].sel(freedom="EXX").transpose("run", "approach", "target")
    np.testing.assert_allclose(found, expected(), rtol=1e-12)
    np.testing.assert_allclose(raw["target_position"], [0, 0.1, 0.2])


def test_names_of_directions_are_translated(imported) -> None:
    log = "Run,Dir,P,Target,Error\n" + "".join(
        f"{r + 1},{'+-'[w]},{t + 1},{POSITIONS[t]},{error(r, w, t)}\n"
        for r in range(3)
        for w in range(2)
        for t in range(3)
    )
    mapping = (
        HEAD
        + 'labels.run = "Run"\nlabels.target = "P"\n'
        + 'labels.approach = {column = "Dir", names = {"+" = "forward", "-" = "backward"}}\n'
        + '[columns]\ntarget_position = {column = "Target", unit = "mm"}\n'
        + 'deviation.EXX = {column = "Error", unit = "um"}\n'
    )
    found = imported(log, mapping)["deviation"].sel(freedom="EXX").transpose("run", "approach", "target")
    np.testing.assert_allclose(found, expected(), rtol=1e-12)


@pytest.mark.parametrize(
    ("mapping", "said"),
    [
        (SEQUENCE.replace('"Position"\n[', '"Place"\n['), "sequence: no column 'Place'"),
        (HEAD + 'columns.deviation.EXX = [{column = "Error", unit = "um"}]\n', "deviation.EXX: expected labels along"),
        (
            HEAD + 'columns.deviation.EXX = {column = "Error", unit = "um", labels = {run = 1}}\n',
            "columns.deviation.EXX: labels are those of several columns",
        ),
        (
            HEAD + 'columns.deviation.EXX = [{column = "Error", unit = "um", labels = {rn = 1}}]\n',
            "labels.rn: unknown dimension; did you mean 'run'",
        ),
        (MONITOR, "sequence: expected a schema with run"),
    ],
)
def test_mistakes_in_a_layout_name_their_key(imported, mapping: str, said: str) -> None:
    with pytest.raises(DatasetError) as caught:
        imported("Position;Error\n0;1\n1;2\n", mapping)
    assert said in str(caught.value)
