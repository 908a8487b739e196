"""A figure over months: its trend covers the truth, steps are found, and chance is rarely taken for one."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from errormotion.cli.app import app
from errormotion.record.history import COVERAGE, YEAR, Value, step, trend

N = 400


def series(rng: np.random.Generator, count: int = 20, slope: float = 0.0, size: float = 0.0) -> list[Value]:
    """Two years of values with U of 0.5 um to 2 um, and a scatter twice as large as stated."""
    t = np.sort(rng.uniform(0, 2 * YEAR, count))
    U = rng.uniform(0.5e-6, 2e-6, count)
    y = 5e-6 + slope * t / YEAR + size * (np.arange(count) >= count // 2) + rng.normal(size=count) * U
    return [Value(str(k), "q", t[k], y[k], U[k], "m") for k in range(count)]


@pytest.mark.parametrize("count", [4, 20])
def test_the_trend_covers_the_truth_as_often_as_stated(count: int) -> None:
    rng = np.random.default_rng(1)
    found = [trend(series(rng, count, 2e-6)) for _ in range(N)]
    covered = np.mean([abs(each.size - 2e-6) <= each.expanded_uncertainty for each in found if each is not None])
    assert covered == pytest.approx(COVERAGE, abs=4 * np.sqrt(COVERAGE * (1 - COVERAGE) / N))


def test_a_step_is_found_at_its_time_with_its_size() -> None:
    rng = np.random.default_rng(2)
    hits = 0
    for _ in range(100):
        values = series(rng, slope=1e-6, size=20e-6)
        found = step(values)
        assert found is not None
        hits += (
            values[9].time < found.time < values[10].time and abs(found.size - 20e-6) < 1.5 * found.expanded_uncertainty
        )
    assert hits >= 90


def test_chance_is_rarely_taken_for_a_step() -> None:
    rng = np.random.default_rng(3)
    alarms = np.mean([step(series(rng, slope=2e-6)) is not None for _ in range(N)])
    assert alarms <= 0.05 + 3 * np.sqrt(0.05 * 0.95 / N)


def test_too_few_values_have_no_trend_and_no_step() -> None:
    rng = np.random.default_rng(4)
    assert trend(series(rng, 2)) is None
    assert step(series(rng, 5)) is None
    assert trend([]) is None


def test_the_command_prints_values_trend_and_what_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    for month in range(1, 7):
        figures = [{"name": "d(Z) 60", "value": month * 1e-6, "expanded_uncertainty": 2e-7, "unit": "m"}]
        state = {
            "schema": "errormotion.run/1",
            "created": f"2026-{month:02}-01T00:00:00+00:00",
            "bench": {"machine": "VM1"},
            "results": figures,
        }
        (tmp_path / f"run-{month}").mkdir()
        (tmp_path / f"run-{month}" / "run.json").write_text(json.dumps(state))
        os.utime(tmp_path / f"run-{month}" / "run.json", (1, 1))

    def call(*options: str, code: int = 0) -> str:
        result = CliRunner().invoke(app, ["history", str(tmp_path), *options])
        assert result.exit_code == code, result.output
        return result.output

    shown = call("--machine", "VM1", "--figure", "d(Z)*")
    assert "2026-06-01 00:00  d(Z) 60   6.00     0.20  um" in shown
    assert "per year" in shown
    found = json.loads(call("--machine", "VM1", "--figure", "d(Z)*", "--json"))
    assert found["trend"]["size"] == pytest.approx(12.1e-6, rel=0.02)
    assert "Figures there: d(Z) 60" in call("--machine", "VM1", "--figure", "other", code=1)
