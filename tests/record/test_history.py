"""``errormotion history``: the figures of run folders over months, as text, JSON, dataset and page."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from coded import raises
from typer.testing import CliRunner
from undrawn import undrawn  # noqa: F401 - a fixture

from errormotion import datasets
from errormotion.cli.app import app
from errormotion.datasets import provenance
from errormotion.datasets.files import events
from errormotion.datasets.results.merit import figures_of, stored
from errormotion.errors import RunError
from errormotion.plugins import FigureOfMerit
from errormotion.record.figures import figure_over_time
from errormotion.record.history import history, version_changes, violations
from errormotion.record.runs.listing import list_runs
from errormotion.record.text import sentences
from errormotion.report import write_run_report

pytestmark = pytest.mark.usefixtures("translated")

FIRST = datetime(2024, 1, 10, 8, tzinfo=UTC)
RUNS, BEFORE = 14, 8
"""Monthly runs, and those before the step of 10 um; the machine was hit between the last of these and the next."""
BAR = 0.5e-6
"""Standard uncertainty of the bar that all runs share, m."""


def errors(values: dict[str, Any], dims: tuple[str, ...], coords: dict[str, Any], **more: Any) -> xr.Dataset:
    """Return an error dataset with u = 0.3 um and the bar in EZ, u = 1 urad of the rotations."""
    shape = tuple(len(coords[dim]) for dim in dims)
    E = np.full((*shape, 6), np.nan)
    for name, value in values.items():
        E[..., ["EX", "EY", "EZ", "EA", "EB", "EC"].index(name)] = value
    F = np.zeros((1, *shape, 6))
    F[..., 2] = BAR
    C = np.diag([0.09e-12, 0.09e-12, 0.09e-12 + BAR**2, 1e-12, 1e-12, 1e-12])
    stated: dict[str, Any] = {"component": "spindle", "functional_point": (0, 0, 0)}
    return datasets.build_errors(
        E,
        np.broadcast_to(C, (*shape, 6, 6)).copy(),
        dims=dims,
        coords=coords,
        influence=F,
        sources=["bar"],
        source_groups=["bar"],
        source_ids={"bar": "certificate 17"},
        machine="VM1",
        frame="machine",
        reference="cold",
        method="foreign",
        method_version="1",
        provenance=provenance.make({}, None, None),
        **(stated | more),
    )


def save(runs: Path, number: int, result: xr.Dataset, **changes: Any) -> Path:
    """Write a run folder with its error dataset."""
    created = FIRST + timedelta(days=30 * number)
    path = runs / f"run-{number:02}"
    (path / "errors" / "a").mkdir(parents=True)
    datasets.save(result, path / "errors" / "a" / "errors.nc")
    state = {
        "schema": "errormotion.run/1",
        "test": "drift",
        "created": created.isoformat(),
        "status": "finished",
        "bench": {"machine": "VM1"},
        "method": {"id": "foreign"},
        "errors": "errors/a/errors.nc",
        "results": [stored(figure) for figure in figures_of(result)],
        **changes,
    }
    (path / "run.json").write_text(json.dumps(state))
    return path


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of monthly runs of one machine with a step, and a note on its cause."""
    runs, rng = tmp_path_factory.mktemp("lab") / "runs", np.random.default_rng(5)
    for k in range(RUNS):
        end = 12e-6 + (10e-6 if k >= BEFORE else 0.0) + 0.3e-6 * rng.normal() + BAR
        values = {"EX": 0.0, "EY": 0.0, "EZ": [0.0, end, end], "EA": 20e-6, "EB": 0.0, "EC": 0.0}
        save(runs, k, errors(values, ("time",), {"time": [0.0, 3600.0, 3600.0 + k + 1]}))
    hit = FIRST + timedelta(days=30 * BEFORE - 10)
    events.append(runs, events.event("hit the vice", at=hit, machine="VM1", by="A. Turner"))
    events.append(runs, events.event("of another machine", at=hit, machine="VM2"))
    events.append(runs / "run-03", events.event("coolant off"))
    return runs


@pytest.fixture(scope="module")
def stored_history(lab: Path, tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    file = tmp_path_factory.mktemp("history") / "h.nc"
    datasets.save(history(list_runs([lab], machine="VM1"), "VM1", "EZ"), file)
    return datasets.load(file).load()


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))

    def run(folder: Path, *options: Any, code: int = 0) -> Any:
        words = ["history", str(folder), "--machine", "VM1", *map(str, options)]
        result = CliRunner().invoke(app, words)
        assert result.exit_code == code, result.output
        if "--json" in options:
            return json.loads(result.stdout)
        return result.output

    return run


def test_the_step_is_named_by_the_note_between_its_runs(lab: Path, call: Callable[..., Any]) -> None:
    found = call(lab, "--figure", "EZ after 60 min", "--json")
    (step,) = found["steps"]
    assert step["event"] == "hit the vice"
    assert abs(step["size"] - 10e-6) <= step["half_width"] < 2e-6
    assert step["low"] <= 30 * 86400 * (BEFORE - 0.5) <= step["high"]
    assert found["trend_low"] <= 0 <= found["trend_high"]
    assert [note["text"] for note in found["notes_on_machine"]] == ["coolant off", "hit the vice"]


def test_a_change_of_the_version_of_the_method_is_marked(tmp_path: Path, call: Callable[..., Any]) -> None:
    runs, rng = tmp_path / "runs", np.random.default_rng(5)
    for k in range(12):
        end = 12e-6 + (10e-6 if k >= 6 else 0.0) + 0.3e-6 * rng.normal()
        values = {"EX": 0.0, "EY": 0.0, "EZ": [0.0, end, end], "EA": 20e-6, "EB": 0.0, "EC": 0.0}
        result = errors(values, ("time",), {"time": [0.0, 3600.0, 3601.0]})
        save(runs, k, result.assign_attrs(method_version="2" if k >= 6 else "1"))
    found = history(list_runs([runs], machine="VM1"), "VM1", "EZ")
    assert version_changes(found) == [(6, "foreign 1", "foreign 2")]
    assert "foreign 1 replaced by foreign 2" in str(found["step_event"].values[0])
    assert any("foreign 1 is replaced by foreign 2" in sentence for sentence in sentences(found))
    (row,) = [line for line in call(runs, "--figure", "EZ").splitlines() if "run-06" in line]
    assert "foreign 2" in row
    plain = call(runs, "--figure", "EZ", "--json")
    assert [each["version"] for each in plain["values"]] == ["foreign 1"] * 6 + ["foreign 2"] * 6
    page = tmp_path / "page.html"
    call(runs, "--figure", "EZ", "--report", page)
    assert "version of the method" in page.read_text()
    # Figures over time that were stored before have no versions.
    assert version_changes(found.drop_vars("version")) == []
    assert violations(found.drop_vars("version")) == []


def test_a_common_source_is_fully_correlated_between_a_freedom_and_a_figure_of_merit(lab: Path) -> None:
    runs = list_runs([lab]).runs[:3]
    for figure in ("EZ after 60 min", "EZ after*"):
        series = figure_over_time(runs, figure).series
        assert series.identities == ["certificate 17"]
        assert series.influence == pytest.approx(BAR)
        assert series.covariance[0, 1] == pytest.approx(BAR**2)
        assert series.covariance[0, 0] == pytest.approx(0.09e-12 + BAR**2)
    assert figure_over_time(runs, "EX after 60 min").series.identities == []


def test_the_influence_stated_by_a_method_for_its_figure_is_used(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def figures(errors: xr.Dataset) -> list[FigureOfMerit]:
        return [replace(figure, influence={"bar": BAR / 2}) for figure in figures_of(errors)]

    monkeypatch.setattr("errormotion.datasets.results.merit.figures_of", figures)
    series = figure_over_time(list_runs([lab]).runs[:3], "EZ after*").series
    assert series.identities == ["certificate 17"]
    assert series.influence == pytest.approx(BAR / 2)


def test_a_freedom_follows_the_functional_point(lab: Path) -> None:
    runs = list_runs([lab]).runs[:3]
    here, there = (figure_over_time(runs, "EZ", at).series for at in ((0, 0, 0), (0, 0.1, 0)))
    assert there.value - here.value == pytest.approx(20e-6 * 0.1)
    assert there.u**2 - here.u**2 == pytest.approx(1e-12 * 0.1**2)


def test_dataset_and_page(lab: Path, call: Callable[..., Any], tmp_path: Path) -> None:
    out, page = tmp_path / "h.nc", tmp_path / "h.html"
    shown = call(lab, "--figure", "EZ", "--out", out, "--report", page)
    assert "noted: hit the vice" in shown
    assert "A. Turner" in shown
    assert "another machine" not in shown
    found = datasets.load(out)
    assert datasets.violations(found) == []
    assert (found.sizes["run"], found.sizes["step"], found.sizes["event"]) == (RUNS, 1, 2)
    assert found["step_event"].values.tolist() == ["hit the vice"]
    text = page.read_text()
    assert text.count("<svg") == 3
    assert not re.search(r"(?:src|href)=\"(?!#)|https?://(?!www\.w3\.org)", text)
    for words in ("hit the vice", "coolant off", "Moving ranges", f"run-{RUNS - 1}"):
        assert words in text
    assert "already exists" in call(lab, "--figure", "EZ", "--out", out, code=1)
    assert CliRunner().invoke(app, ["validate", str(out)]).exit_code == 0
    again = CliRunner().invoke(app, ["report", str(out), "--out", str(tmp_path / "again.html")])
    assert again.exit_code == 0, again.output


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda ds: ds.drop_vars("value"), "value: missing"),
        (lambda ds: ds.drop_vars("run"), "run: missing"),
        (lambda ds: ds.assign(value=ds["value"] * np.nan), "value: expected known numbers"),
        (lambda ds: ds.assign(time=-ds["time"]), "time: expected the oldest run first"),
        (lambda ds: ds.assign(expanded_uncertainty=-ds["expanded_uncertainty"]), "expected values above 0"),
        (lambda ds: ds.assign(step_p=ds["step_p"] + 1), "step_p: expected probabilities"),
        (lambda ds: ds.assign(step_low=ds["step_low"] + 1e9), "step_time: expected times between"),
        (lambda ds: ds.assign(step_event=ds["step_p"]), "step_event: expected text"),
        (lambda ds: ds.assign(influence=ds["influence"] * 1e3), "influence: expected shared sources"),
        (lambda ds: ds.assign(trend=ds["value"]), "trend: expected dims ()"),
        (lambda ds: ds.assign(trend_low=ds["trend_high"] + 1), "trend_low: expected a value up to"),
        (lambda ds: ds.assign_attrs(unit="furlong"), "attribute 'unit'"),
        (lambda ds: ds.assign_attrs(start="soon"), "attribute 'start'"),
    ],
)
def test_a_history_that_violates_its_schema_is_an_error(
    stored_history: xr.Dataset, change: Callable[[xr.Dataset], xr.Dataset], expected: str
) -> None:
    (first, *_) = datasets.violations(change(stored_history))
    assert expected in first


@pytest.mark.usefixtures("undrawn")
def test_a_history_without_steps_and_notes_is_stored(tmp_path: Path, call: Callable[..., Any]) -> None:
    for k in range(2):
        values = {"EX": 1e-6, "EZ": 1e-6 * k}
        save(tmp_path / "runs", k, errors(values, ("time",), {"time": [0.0]}))
    call(tmp_path / "runs", "--figure", "EX", "--out", tmp_path / "h.nc", "--report", tmp_path / "h.html")
    found = datasets.load(tmp_path / "h.nc")
    assert datasets.violations(found) == []
    assert found.sizes["step"] == 0
    assert np.isnan(found["trend"])


def test_an_unknown_name_is_reported_with_the_available_ones(lab: Path, call: Callable[..., Any]) -> None:
    shown = call(lab, "--figure", "hysteresis", code=1)
    assert "'EZ after 60.0 min'" in shown
    assert "EX to EC" in shown
    assert "matches several figures of run-00" in call(lab, "--figure", "E*", code=1)
    assert "has no deviation" in call(lab, "--figure", "deviation", code=1)
    assert "a freedom, such as EZ" in call(lab, "--figure", "EZ after*", "--at", "0,0,0", code=1)
    call(lab, "--figure", "EZ", "--at", "here", code=2)
    assert (
        "did you mean 'VM1'?"
        in CliRunner().invoke(app, ["history", str(lab), "--machine", "VM", "--figure", "EZ"]).output
    )
    assert "No value of 'EZ' in 0 runs" in call(lab, "--figure", "EZ", "--test", "other", code=1)


def test_short_forms_name_the_figure_of_a_standard(tmp_path: Path) -> None:
    names = ["d(Z) within the first 60 min, range (ISO 230-3)", "d(X1) within the first 60 min, range (ISO 230-3)"]
    figures = [{"name": name, "value": 1e-6, "expanded_uncertainty": 2e-7, "unit": "m"} for name in names]
    save(tmp_path, 0, errors({"EX": 0.0}, ("time",), {"time": [0.0]}), results=figures)
    runs = list_runs([tmp_path]).runs
    for short in ("d(Z)60", "d(Z) 60", "d(Z) within", "d(Z)*"):
        assert figure_over_time(runs, short).series.names == [names[0]]
    for wrong in ("d(Z)61", "60", "d(Y)60"):
        with raises("figure.no_value"):
            figure_over_time(runs, wrong)


def test_errors_at_a_position_and_at_a_target(tmp_path: Path) -> None:
    x = np.linspace(0.0, 0.4, 5)
    axis = errors({"EX": 1e-5 * x}, ("position",), {"position": np.arange(5)}, component="X")
    save(tmp_path, 0, axis.assign_coords(x=("position", x, {"units": "m"})))
    series = figure_over_time(list_runs([tmp_path]).runs, "EX", (0.2, 0, 0)).series
    assert series.value == pytest.approx([2e-6])
    with pytest.raises(RunError, match="is unknown"):
        figure_over_time(list_runs([tmp_path]).runs, "EX", (0.9, 0, 0))
    volume = errors({"EY": [1e-6, 2e-6]}, ("target",), {"target": ["a", "b"]}, component="tool")
    places = {axis: ("target", [0.0, 0.3], {"units": "m"}) for axis in "xyz"}
    save(tmp_path / "volume", 0, volume.assign_coords(places))
    runs = list_runs([tmp_path / "volume"]).runs
    assert figure_over_time(runs, "EY", (0.3, 0.3, 0.3)).series.value == pytest.approx([2e-6])
    with pytest.raises(RunError, match=r"nearest position is 17\.3 mm away"):
        figure_over_time(runs, "EY", (0.31, 0.31, 0.31))
    with pytest.raises(RunError, match="state the place by --at"):
        figure_over_time(runs, "EY")


def test_unreadable_runs_are_omitted_and_named(lab: Path, tmp_path: Path, call: Callable[..., Any]) -> None:
    for k in range(4):
        save(tmp_path, k, errors({"EX": 1e-6 * k}, ("time",), {"time": [0.0, 60.0]}))
    (tmp_path / "run-01" / "errors" / "a" / "errors.nc").write_bytes(b"damaged")
    (tmp_path / "run-02" / "run.json").write_text("{")
    found = call(tmp_path, "--figure", "EX", "--json")
    assert [each["run"] for each in found["values"]] == ["run-00", "run-03"]
    assert "run-01" in found["left_out"][0]
    assert "run-02" in found["skipped"][0]


def test_values_of_several_components_have_a_remark(tmp_path: Path, call: Callable[..., Any]) -> None:
    for k, component in enumerate(("spindle", "tool")):
        point = (0, 0, 0.1 * k)
        result = errors({"EX": 1e-6}, ("time",), {"time": [0.0]}, component=component, functional_point=point)
        save(tmp_path, k, result)
    notes = " ".join(call(tmp_path, "--figure", "EX", "--json")["notes"])
    assert "several components: spindle; tool" in notes
    assert "several functional points" in notes


@pytest.mark.usefixtures("undrawn")
def test_the_report_of_a_run_shows_its_notes(lab: Path, tmp_path: Path) -> None:
    text = write_run_report(lab / "run-03", tmp_path / "r.html").read_text()
    assert "Notes on this run" in text
    assert "coolant off" in text
    assert "Notes on this run" not in write_run_report(lab / "run-04", tmp_path / "s.html").read_text()
