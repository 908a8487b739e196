"""`errormotion monitor`: output on a terminal and as JSON."""

import errno
import io
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import CliRunner
from rich.console import Console

from errormotion.campaign.folder import RunFolder, list_runs
from errormotion.campaign.monitor.watch import Monitor, Snapshot
from errormotion.campaign.storage.store import RawStore
from errormotion.cli.app import app
from errormotion.cli.commands.instruments.monitor import MIN_SPAN, Screen, clock
from errormotion.cli.curves import bars

BENCH = """\
schema = "errormotion.bench/1"
name = "Shop"
machine = "Mill 5"
[instruments.modules]
driver = "dcon_temperature"
address = "sim://cframe/t?seed=21&sensors=spindle_front,column&open=1"
channels = ["spindle", "column"]
"""


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    path = tmp_path / "bench.toml"
    path.write_text(BENCH)
    return path


def test_each_row_is_a_line_of_json_for_a_program(bench: Path) -> None:
    result = CliRunner().invoke(app, ["monitor", str(bench), "--interval", "500 ms", "--duration", "2 s", "--json"])
    assert result.exit_code == 0, result.output
    rows = [json.loads(line) for line in result.stdout.splitlines()]
    assert 1 <= len(rows) <= 5
    assert all(row["time"] < 2.5 for row in rows)
    assert 15 < rows[-1]["temperatures"]["spindle"] < 25
    assert rows[-1]["temperatures"]["column"] is None
    assert "column" in rows[-1]["flags"]


def test_the_end_states_the_path_of_the_log(bench: Path) -> None:
    result = CliRunner().invoke(app, ["monitor", str(bench), "--interval", "50 ms", "--duration", "100 ms"])
    assert re.match(r"[123] rows over 00:00:00 in runs/\S+-monitor-\S+\.", result.stdout)


def test_a_monitor_stopped_before_the_start_of_its_log_ends_as_stopped(
    bench: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(self: Monitor) -> Monitor:
        raise KeyboardInterrupt

    monkeypatch.setattr(Monitor, "__enter__", stop)
    result = CliRunner().invoke(app, ["monitor", str(bench), "--duration", "1 s"])
    assert result.exit_code == 130, result.output
    assert "Interrupted" in result.output


@pytest.mark.parametrize(
    ("error", "status"), [(OSError(errno.ENOSPC, "full"), "failed"), (KeyboardInterrupt(), "interrupted")]
)
def test_a_monitor_that_cannot_start_states_it_in_its_run(
    bench: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, status: str
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(RawStore, "create", fail)
    result = CliRunner().invoke(app, ["monitor", str(bench), "--duration", "1 s"])
    assert result.exit_code in (1, 130), result.output
    (run,) = list_runs(tmp_path / "runs")
    assert run.data["status"] == status
    assert run.data["reason"]


@pytest.mark.parametrize("stopped", [False, True])
def test_a_monitor_on_a_full_disk_reports_the_stored_amount(
    bench: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stopped: bool
) -> None:
    """It is also reported if run.json cannot be written, and if the last rows of a stopped monitor are lost."""

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def watch(self: Monitor, duration: float) -> Iterator[Snapshot]:
        for number, snapshot in enumerate(rows(self, duration)):
            yield snapshot
            if number == 1:
                monkeypatch.setattr(RawStore, "commit", full)
                monkeypatch.setattr(RunFolder, "save", full) if not stopped else None
                if stopped:
                    raise KeyboardInterrupt

    rows = Monitor.watch
    monkeypatch.setattr(Monitor, "watch", watch)
    result = CliRunner().invoke(app, ["monitor", str(bench), "--interval", "100 ms", "--duration", "20 s"])
    assert result.exit_code == 1, result.output
    assert re.search(r"The disk is full: \d+ along 'time' are stored in", result.output)
    (run,) = list_runs(tmp_path / "runs")
    assert run.data["status"] == ("failed" if stopped else "running")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--interval", "5"], "--interval: expected a time with its unit, such as '104 min'; found '5'"),
        (["--duration", "0 s"], "--duration: expected more than 0 s; found '0 s'"),
    ],
)
def test_an_invalid_time_is_reported(bench: Path, arguments: list[str], message: str) -> None:
    result = CliRunner().invoke(app, ["monitor", str(bench), *arguments])
    assert result.exit_code == 1
    assert message in result.stderr
    assert not list(Path().glob("runs/*"))


def page(*snapshots: Snapshot) -> str:
    screen = Screen(tuple(snapshots[0].temperatures))
    for snapshot in snapshots:
        screen.take(snapshot)
    console = Console(width=120, file=io.StringIO())
    with console.capture() as captured:
        console.print(screen.page("Mill 5", snapshots[-1], Path("runs/x")))
    return captured.get()


def test_the_page_shows_temperatures_parameters_alarms_and_silent_instruments() -> None:
    state = {
        "position": [0.1, 0.0, -0.05],
        "spindle_speed": 12000.0,
        "spindle_load": math.nan,
        "feed": 0.025,
        "mode": "automatic",
        "program": "warm.ngc",
        "alarms": ["spindle hot"],
    }
    cold = Snapshot(0.0, {"spindle": 20.0, "column": 19.5}, {}, state, {}, 1)
    warm = Snapshot(
        1800.0, {"spindle": 26.0, "column": math.nan}, {"column": "open"}, state, {"far": "no answer"}, 2, {"far": 7}
    )
    lines = page(cold, warm).splitlines()
    assert "00:30:00" in lines[0]
    spindle = next(line for line in lines if line.startswith("spindle")).split()
    assert spindle[:6] == ["spindle", "26.00", "+6.00", "+12.00", "20.00", "26.00"]
    assert next(line for line in lines if line.startswith("column")).split()[:2] == ["column", "open"]
    text = "\n".join(lines)
    for reported in ("X 100.000  Y 0.000  Z -50.000 mm", "12000 /min", "1500 mm/min", "warm.ngc", "spindle hot"):
        assert reported in text
    assert "far is silent: no answer" in text
    assert "rows without an answer: far 7" in text


def test_bars_leave_a_blank_for_unknown_values() -> None:
    assert bars([20.0, math.nan, 28.0]) == "▁ █"
    assert bars([20.0, 20.001], MIN_SPAN) == "▁▁"  # a thousandth of a kelvin is no mountain
    assert bars([math.nan]) == ""


def test_a_clock_counts_days() -> None:
    assert clock(59.9) == "00:00:59"
    assert clock(2 * 86400 + 3661) == "2 d 01:01:01"
