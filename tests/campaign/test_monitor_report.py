"""The page of a monitor's log: numbers of the log, gaps marked and counted, however long it is."""

import json
import re
from html import unescape

import numpy as np
import pytest
import xarray as xr
from coded import raises
from undrawn import undrawn  # noqa: F401 - a fixture

from errormotion.campaign.monitor import log as monitor_log
from errormotion.campaign.monitor.plugin import MonitorLog
from errormotion.campaign.monitor.schema import SCHEMA
from errormotion.datasets import save
from errormotion.methods.normal_vector import simulation
from errormotion.report import write_report, write_run_report
from errormotion.twin import VirtualMachine

pytestmark = pytest.mark.usefixtures("translated")

MEANINGS = ["known", "open", "shorted", "out of range", "no answer", "unknown"]


def log(n=200, interval=1.0, *, controller=True):
    """Two instruments and four sensors: 'motor' open for a tenth, 'ambient' never known, 'thermo' silent twice."""
    t = interval * np.arange(n)
    rng = np.random.default_rng(2)
    temperature = 20 + np.outer(t / max(t[-1], 1.0), [6.0, 3.0, -1.0, 0.0]) + 0.01 * rng.normal(size=(n, 4))
    flag, gap = np.zeros((n, 4), np.int8), np.zeros((n, 2), np.int8)
    tenth = n // 10
    flag[tenth : 2 * tenth, 1] = 1
    flag[:, 3] = 4
    for start, stop in ((4 * tenth, 5 * tenth), (7 * tenth, 7 * tenth + 3)):
        gap[start:stop, 1] = 1
        flag[start:stop] = 4
    temperature[flag > 0] = np.nan
    data = {
        "gap": (("time", "source"), gap, {"units": "1"}),
        "temperature": (("time", "sensor"), temperature, {"units": "degC"}),
        "temperature_flag": (("time", "sensor"), flag, {"units": "1"}),
        "sensor_place": (
            ("sensor", "direction"),
            [[0.3, 0, 0.6], [0.3, 0.1, 0.7], [0, -0.3, 0.2], [np.nan] * 3],
            {"units": "m"},
        ),
    }
    if controller:
        data["position"] = (("time", "direction"), np.outer(np.sin(t / 9), [0.2, 0.1, 0.0]), {"units": "m"})
        data["spindle_speed"] = ("time", np.where(t < t[-1] / 2, 0.0, 6000.0), {"units": "1/min"})
        data["spindle_load"] = ("time", np.full(n, 0.25), {"units": "1"})
        data["feed"] = ("time", np.full(n, 0.05), {"units": "m/s"})
    coords = {
        "time": ("time", t, {"units": "s"}),
        "sensor": ["spindle", "motor", "bed", "ambient"],
        "source": ["control", "thermo"],
        "direction": ["x", "y", "z"],
    }
    attrs = {
        "schema": SCHEMA,
        "machine": "Mill 5",
        "start": "2026-03-02T08:15:00+00:00",
        "interval": interval,
        "flag_meanings": json.dumps(MEANINGS),
    }
    return xr.Dataset(data, coords, attrs)


def words(html):
    text = re.sub(r"<[^>]+>", " ", re.sub(r"<style>.*?</style>", "", html, flags=re.S))
    return re.sub(r"\s+", " ", unescape(text))


def rows(html, caption):
    table = next(t for t in re.findall(r"<table.*?</table>", html, re.S) if caption in words(t))
    found = re.findall(r"<tr>(.*?)</tr>", table, re.S)
    return [[words(cell).strip() for cell in re.findall(r"<t[hd].*?</t[hd]>", row, re.S)] for row in found]


@pytest.fixture(scope="module")
def html(tmp_path_factory):
    return write_report(log(), tmp_path_factory.mktemp("log") / "r.html").read_text(encoding="utf-8")


def test_page_is_that_of_a_log_and_not_of_a_test(html):
    assert "<h1>Log of a monitor</h1>" in html
    assert "Test report" not in html
    assert "Approved by" not in html
    assert "2026-03-02 08:15" in html
    assert html.count("<script") == 1  # that of the page


def test_gaps_are_counted_drawn_and_listed(html):
    found = {row[0]: row[1:] for row in rows(html, "Rows without a recent reading")}
    assert found["control"] == ["0", "0", "0 %", "none", "no"]
    # A tenth of 200 rows, and three more; a gap ends with the first row that has a reading again.
    assert found["thermo"] == ["2", "23", "11.50 %", "20.0 s", "no"]
    first, second = rows(html, "Gaps in chronological order")[1:]
    assert first == ["thermo", "1.33", "1.67", "20.0 s", "20"]
    assert second == ["thermo", "2.33", "2.38", "3.0 s", "3"]
    assert "No answer: thermo" in html
    assert "No answer: control" not in html


def test_why_a_temperature_is_unknown_is_reported(html):
    found = {row[0]: row for row in rows(html, "Temperatures in °C")}
    assert found["motor"][7].startswith("21.50 %")
    assert found["ambient"][7].startswith("100 %")
    assert found["ambient"][2].startswith("—")
    text = words(html)
    assert "of motor: open in 20 rows and no answer in 23 rows" in text
    assert "Without a valid reading: ambient" in text
    assert "Position unknown: ambient" in text


def test_working_parameters_are_those_of_the_log(html):
    found = {row[0]: row[1:] for row in rows(html, "Working parameters")}
    assert found["Spindle speed"] == ["1/min", "0", "3000", "6000", "6000", "100 %"]
    assert found["Spindle load"][1:5] == ["25.0"] * 4
    assert found["Feed"][:2] == ["m/min", "3.0"]
    assert found["Position X"][1] == "−200.0"


@pytest.mark.usefixtures("undrawn")
def test_a_log_without_a_controller_states_it(tmp_path):
    text = words(write_report(log(controller=False), tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "The bench had no controller" in text
    assert "Spindle speed" not in text


@pytest.mark.usefixtures("undrawn")
def test_rows_that_were_not_written_are_a_gap(tmp_path):
    whole = log()
    part = whole.isel(time=np.r_[0:100, 150:200])
    text = words(write_report(part, tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "No rows were written in one interval, 51.0 s in total." in text
    assert np.isnan(monitor_log.read_log(part).temperatures[0].values).any()  # the curve breaks there


@pytest.mark.parametrize("block", [1000, 7, 10**6])
def test_a_long_log_is_read_in_blocks_with_equal_results(monkeypatch, block):
    long = log(5000, 60.0)
    monkeypatch.setattr(monitor_log, "BLOCK", block)
    found = monitor_log.read_log(long)
    assert found.time.size == 2 * monitor_log.BINS
    for channel, column in zip(found.temperatures, long["temperature"].values.T, strict=True):
        known = column[np.isfinite(column)]
        assert channel.known == known.size
        if known.size:
            expected = [known[0], known.min(), known.max(), known[-1], known.mean()]
            assert [channel.first, channel.low, channel.high, channel.last, channel.mean] == pytest.approx(expected)
            assert np.nanmax(channel.values) == known.max()
    assert [(gap.start, gap.end, gap.rows) for gap in found.gaps["thermo"]] == [
        (2000 * 60.0, 2500 * 60.0, 500),
        (3500 * 60.0, 3503 * 60.0, 3),
    ]
    assert found.silent["thermo"].sum() > 0
    assert not found.silent["control"].any()


def test_a_short_gap_in_a_long_log_is_visible():
    found = monitor_log.read_log(log(5000, 60.0))
    at = np.flatnonzero(found.silent["thermo"])
    assert (np.abs(found.time[at] - 3501 * 60.0) < 600.0).any()


def test_figures_are_those_of_the_page(html):
    found = {figure.name: (figure.value, figure.unit) for figure in MonitorLog.figures(log())}
    assert found["duration"] == (199.0, "s")
    assert found["rows without a reading of thermo"] == (23.0, "1")
    assert found["rows without a reading of control"] == (0.0, "1")
    assert f"{found['temperature change of spindle'][0]:+.1f} K" in words(html)
    assert f"{found['highest temperature of spindle'][0]:.1f} °C" in words(html)


@pytest.mark.usefixtures("undrawn")
def test_log_of_one_row_and_of_none_have_a_page(tmp_path):
    assert "1 rows" in words(write_report(log().isel(time=[0]), tmp_path / "r.html").read_text(encoding="utf-8"))
    assert monitor_log.read_log(log().isel(time=[])).rows == 0


@pytest.mark.usefixtures("undrawn")
def test_the_page_of_the_run_folder_of_a_monitor_is_written(tmp_path):
    folder = tmp_path / "20260302T081500Z-monitor-ab12"
    folder.mkdir()
    save(log(), folder / "raw.zarr")
    run = {
        "schema": "errormotion.run/1",
        "id": "ab12",
        "test": "monitor",
        "instruments": [
            {"name": "thermo", "address": "sim://cframe/t", "settings": {"places": {"ambient": [1, 2, 3]}}}
        ],
        "settings": {"interval": 1.0},
    }
    (folder / "run.json").write_text(json.dumps(run))
    assert write_run_report(folder) == folder / "report.html"
    html = (folder / "report.html").read_text(encoding="utf-8")
    assert "SIMULATED DATA" in html
    assert "ab12" in html
    assert "sim://cframe/t" in words(html)
    assert {row[0]: row for row in rows(html, "Temperatures in °C")}["ambient"][1] == "1000, 2000, 3000"
    assert write_run_report(folder, tmp_path / "elsewhere.html").read_text(encoding="utf-8").count("<figure") == 2


def test_run_folder_without_results_is_no_log(tmp_path):
    folder = tmp_path / "20260302T081500Z-drift-ab12"
    folder.mkdir()
    machine = VirtualMachine("gantry", seed=3)
    machine.start([])
    save(simulation.raw(machine, np.array([0.0, 600.0]), seed=1), folder / "raw.zarr")
    with raises("run.no_errors"):
        write_run_report(folder)
