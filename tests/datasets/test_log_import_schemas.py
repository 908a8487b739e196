"""Every raw schema can be imported: the dataset from a log has the contents of the log."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from errormotion import datasets, plugins
from errormotion.datasets.importing import import_log
from errormotion.datasets.schemas import RawSchema, Row, raw_schemas
from errormotion.errors import PluginWarning
from errormotion.plugins import MethodInfo

FOREIGN = Path(__file__).parents[2] / "examples" / "reference_touches"
FREE = 3
"""Length of a dimension without a length in the schema."""
SECOND = {"direction_": "direction", "p_": "p"}


def foreign() -> tuple[RawSchema, ...]:
    """Return the raw schemas of the method in a separate distribution."""
    spec = importlib.util.spec_from_file_location("foreign_method", FOREIGN / "reference_touches.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.ReferenceTouches.raw_schemas


TABLES = (*raw_schemas(), *foreign())


def content(table: RawSchema, rng: np.random.Generator) -> xr.Dataset:
    """Return a dataset with random plausible values of all variables of a raw schema."""
    variables = {row.name: xr.Variable(row.dims, values(row, table, rng)) for row in table.rows}
    for row in table.rows:
        if row.unit:
            variables[row.name].attrs["units"] = row.unit
    used = {dim for row in table.rows for dim in row.dims}
    coords = {dim: list(labels) for dim, labels in table.labels.items() if dim in used}
    return xr.Dataset(variables, coords, {"schema": table.id})


def values(row: Row, table: RawSchema, rng: np.random.Generator) -> np.ndarray:
    shape = tuple(table.sizes.get(dim, len(table.labels.get(dim, ())) or FREE) for dim in row.dims)
    low, high = (limit if np.isfinite(limit) else np.sign(limit) * 1e3 for limit in (row.low, row.high))
    drawn = low + (high - low) * rng.uniform(0.1, 0.9, shape)
    if row.name == "time":
        return np.sort(drawn)
    if row.name.endswith("covariance"):
        return np.broadcast_to(np.diag(np.arange(1.0, shape[-1] + 1) * 1e-9), shape)
    if row.unit == "1" and row.dims and row.dims[-1] == "direction":
        drawn = rng.normal(size=shape)
        return drawn / np.linalg.norm(drawn, axis=-1, keepdims=True)
    return np.round(drawn) if (row.low, row.high) in ((0, 255), (0, 1000), (0, 100000)) else drawn


def log_and_map(raw: xr.Dataset, table: RawSchema) -> tuple[str, str]:
    """Return a log and its map: columns for the variables of the most dimensions and their subsets, the rest stated."""
    sizes = raw.sizes

    def component(row: Row) -> str | None:
        return next((dim for dim in reversed(row.dims) if dim in table.labels or dim == "sensor"), None)

    def record(row: Row) -> tuple[str, ...]:
        return tuple(dim for dim in row.dims if dim != component(row))

    widest = max((record(row) for row in table.rows if "covariance" not in row.name), key=len)
    names = {dim: table.labels.get(dim, tuple(f"{dim} {k}" for k in range(sizes[dim]))) for dim in sizes}
    columns: dict[str, tuple[Row, int | None]] = {}
    stated: list[Row] = []
    for row in table.rows:
        if not record(row) or not set(record(row)) <= set(widest):
            stated.append(row)
        elif component(row) is None:
            columns[row.name] = (row, None)
        else:
            columns |= {f"{row.name}.{label}": (row, k) for k, label in enumerate(names[component(row)])}
    lines = [";".join([*(f"label of {dim}" for dim in widest), *columns])]
    for place in np.ndindex(tuple(sizes[dim] for dim in widest)):
        at = dict(zip(widest, place, strict=True))
        cells = [names[dim][k] for dim, k in at.items()]
        for row, k in columns.values():
            picked = raw[row.name].isel({dim: at[dim] for dim in record(row)})
            cells.append(repr(float(picked if k is None else picked[k])))
        lines.append(";".join(cells))
    head = [f'schema = "{table.id}"', *([f'variant = "{table.variant}"'] if table.variant else [])]
    head += ["[labels]", *(f'{dim} = "label of {dim}"' for dim in widest), "[columns]"]
    for key, (row, _) in columns.items():
        name, _, label = key.partition(".")
        dotted = f'."{label}"' if label else ""
        head.append(f'{name}{dotted} = {{column = "{key}", unit = "{row.unit}"}}')
    head += ["[values]"]
    head += [f'{row.name} = {{value = {raw[row.name].values.tolist()}, unit = "{row.unit}"}}' for row in stated]
    return "\n".join(lines) + "\n", "\n".join(head) + "\n"


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.title)
def test_a_log_of_any_raw_schema_is_imported(table: RawSchema, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if table in foreign():
        monkeypatch.setattr(plugins, "owner_of_schema", lambda schema: Foreign)
    raw = content(table, np.random.default_rng(7))
    assert datasets.violations(raw) == []
    log, mapping = log_and_map(raw, table)
    (tmp_path / "log.csv").write_text(log)
    (tmp_path / "map.toml").write_text(mapping)
    found = import_log(tmp_path / "log.csv", tmp_path / "map.toml", tmp_path / "raw.nc")
    assert set(found.variables) >= {row.name for row in table.rows}
    for row in table.rows:
        np.testing.assert_allclose(found[row.name].transpose(*row.dims), raw[row.name], rtol=1e-12, err_msg=row.name)
        assert found[row.name].attrs == raw[row.name].attrs


def test_the_log_of_a_foreign_method_is_imported_with_the_map_of_its_distribution(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plugins, "owner_of_schema", lambda schema: Foreign)
    lines = ["Time,Repeat,X,Y,Z,T"]
    lines += [f"{time},1,100,200.5,{300 + time * 1e-3},20.5" for time in (0, 60, 120)]
    (tmp_path / "log.txt").write_text("\n".join(lines) + "\n")
    raw = import_log(tmp_path / "log.txt", FOREIGN / "import.toml", tmp_path / "raw.nc")
    assert datasets.violations(raw) == []
    assert raw["touch"].sel(direction="y").values == pytest.approx(np.full((3, 1), 0.2005))
    assert raw["touch"].sel(direction="z").values[:, 0] == pytest.approx([0.3, 0.30006, 0.30012])


def test_the_log_of_a_ballbar_is_imported_by_its_former_name(tmp_path: Path) -> None:
    """The map of version 0.1 still works."""
    lines = ["direction\tcircle\tlength\tangle\ttime\tT"]
    for run, way in enumerate(("CCW", "CW"), 1):
        lines += [f"{way}\t1\t{150 + run * 1e-3}\t{angle}\t{60 * run + angle}\t20.5" for angle in (0, 90, 180)]
    (tmp_path / "log.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "map.toml").write_text(MAP)
    plugins.refresh()
    with pytest.warns(PluginWarning, match="'ballbar' is called 'circular_test' now"):
        raw = import_log(tmp_path / "log.txt", tmp_path / "map.toml", tmp_path / "raw.nc")
    assert datasets.violations(raw) == []
    assert raw["length"].dims == ("direction_of_travel", "run", "sample")
    np.testing.assert_allclose(raw["length"].sel(direction_of_travel="CW"), np.full((1, 3), 0.150002), rtol=1e-12)
    np.testing.assert_allclose(raw["angle"][0, 0], [0, np.pi / 2, np.pi], rtol=1e-12)


MAP = """
schema = "errormotion.raw.ballbar/1"
machine = "machining centre 7"
labels = {direction_of_travel = "direction", run = "circle"}

[columns]
length = {column = "length", unit = "mm"}
angle = {column = "angle", unit = "deg"}
reading_time = {column = "time", unit = "s"}
temperature = {column = "T", unit = "degC"}

[values]
nominal_radius = "150 mm"
feed = "1000 mm/min"
centre = ["0 mm", "0 mm", "0 mm"]
axis_direction = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
length_uncertainty = "0.5 um"
"""


class Foreign:
    """A method that is not installed."""

    info = MethodInfo("reference_touches", "", "simulated_only")
    raw_schemas = foreign()
