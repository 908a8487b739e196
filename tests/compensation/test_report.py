"""Pages of thermal models: a prediction with its interval, and a comparison with another campaign."""

import json
import re
from html import unescape

import numpy as np
import pytest
from undrawn import undrawn  # noqa: F401 - a fixture

from errormotion.compensation.thermal_model import ThermalModelSettings, check, fit
from errormotion.compensation.thermal_model.report import write_model_report
from errormotion.datasets.schemas import DOF
from errormotion.report import write_report
from errormotion.report.text import fixed
from errormotion.twin import Event, VirtualMachine

pytestmark = pytest.mark.usefixtures("translated")

OFF = {"X": False, "Y": False, "Z": False}
SPEEDS = ((4000.0, 8000.0), (9000.0, 3000.0), (6000.0, 7000.0), (15000.0, 15000.0))
SIZE = [1e-6] * 3 + [np.pi / 180 / 3600] * 3
FIGURES = ("rms", "remaining", "removed", "held")


def words(html):
    text = re.sub(r"<[^>]+>", " ", re.sub(r"<style>.*?</style>", "", html, flags=re.S))
    return re.sub(r"\s+", " ", unescape(text))


def rows(html, caption):
    table = next(t for t in re.findall(r"<table.*?</table>", html, re.S) if caption in words(t))
    found = re.findall(r"<tr>(.*?)</tr>", table, re.S)
    return [[words(cell).strip() for cell in re.findall(r"<t[hd].*?</t[hd]>", row, re.S)] for row in found]


def number(text):
    return float(text.split("±")[0].replace("−", "-").replace("+", ""))


@pytest.fixture(scope="module")
def warm_ups():
    """Four warm-ups of one virtual machine with exact errors; the last is hotter than all others."""
    machine, found = VirtualMachine("cframe", 5), []
    for early, late in SPEEDS:
        machine.start((Event(0.0, early, OFF), Event(3600.0, late)))
        found.append(machine.truth_spindle(np.arange(0.0, 7201.0, 300.0)).load())
    return found


@pytest.fixture(scope="module")
def model(warm_ups):
    settings = ThermalModelSettings(
        variant="auto", sensors=("spindle_front", "column"), lags=(600.0,), time_constants=(1800.0,)
    )
    return fit(warm_ups[:2], settings)


def page_of(model, measured, folder):
    """Return the comparison of a model with a measurement, and its page."""
    found = check(model, measured)
    figures = {name: getattr(found, name) for name in FIGURES}
    page = write_model_report(model.dataset, measured, folder / "r.html", predicted=found.predicted, figures=figures)
    return found, page.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def checked(model, warm_ups, tmp_path_factory):
    return page_of(model, warm_ups[2], tmp_path_factory.mktemp("check"))


def test_figures_of_the_check_are_on_the_page(checked):
    found, html = checked
    reported = {row[0]: row[1:] for row in rows(html, "Root mean square of the measured errors")}
    for i, name in enumerate(DOF):
        assert number(reported[name][1]) == pytest.approx(found.rms[i] / SIZE[i], abs=0.006)
        assert number(reported[name][2]) == pytest.approx(found.remaining[i] / SIZE[i], abs=0.006)
        assert reported[name][3] == fixed(100 * found.removed[i], 0)
        assert reported[name][4] == fixed(100 * found.held[i], 0)
    least = DOF[int(np.argmin(found.removed))]
    assert f"(lowest: {least})" in words(html)


def test_candidates_and_their_scores_are_those_of_the_provenance(checked, model):
    steps = json.loads(model.dataset.attrs["provenance"])["steps"]
    tried = next(step["tried"] for step in steps if "tried" in step)
    reported = rows(checked[1], "Candidates: the best of each variant")[1:]
    assert len(reported) == len(tried) == 2
    for row, each in zip(reported, tried, strict=True):
        assert row[0] == each["variant"]
        assert number(row[3]) == pytest.approx(each["score"], rel=0.005)
    assert [row[4] for row in reported] == ["selected", ""]
    assert "spindle_front and column" in reported[0][2]


def test_coefficients_and_their_units_are_those_of_the_model(checked, model):
    ds = model.dataset
    for caption, first in (("Coefficients of the displacements", 0), ("Coefficients of the rotations", 3)):
        reported = rows(checked[1], caption)[1:]
        assert [row[0] for row in reported] == [feature.name for feature in model.features]
        for k, row in enumerate(reported):
            assert row[1] == ("K" if not model.features[k].parameter else row[1])
            for column in range(3):
                i = first + column
                expected = float(ds["coefficient"][i, k]) / SIZE[i]
                expanded = 2 * float(np.sqrt(ds["coefficient_covariance"][i, k, k])) / SIZE[i]
                assert number(row[3 + column]) == pytest.approx(expected, abs=0.06 * expanded)


def test_a_simulated_measurement_has_a_banner(checked):
    assert "SIMULATED DATA" in checked[1]


def test_residual_outside_the_interval_is_red(checked, model, warm_ups, tmp_path):
    wrong = warm_ups[2].copy(deep=True)
    wrong["EZ"][7] += 300e-6
    drawn = []
    for found, html in (checked, page_of(model, wrong, tmp_path)):
        section = html[html.index("<h2>Residuals</h2>") : html.index("<h2>Temperatures and working parameters</h2>")]
        red = sum(np.round((1 - found.held) * wrong.sizes["time"]).astype(int))
        # Each marker is one use of its symbol, with its colour.
        drawn.append(len(re.findall(r"<use [^>]*fill: #b3261e", section)) - red)
    assert drawn == [0, 0]
    assert red > 0


def test_error_that_was_not_measured_is_not_compared(model, warm_ups, tmp_path):
    part = warm_ups[2].copy(deep=True)
    part["EC"][:] = np.nan
    _, html = page_of(model, part, tmp_path)
    assert "Not compared because unknown: EC." in words(html)
    assert html.count("not compared") == 2
    row = next(row for row in rows(html, "Root mean square of the measured errors") if row[0] == "EC")
    assert row[2].startswith("—")


@pytest.mark.usefixtures("undrawn")
def test_a_prediction_is_shown_as_not_measured(model, warm_ups, tmp_path):
    predicted = model.predict(warm_ups[2])
    html = write_report(predicted, tmp_path / "r.html").read_text(encoding="utf-8")
    assert "<h1>Errors predicted by a thermal model</h1>" in html
    assert "instants; not measured." in words(html)
    reported = {row[0]: row for row in rows(html, "The six errors as predicted")}
    for i, name in enumerate(DOF):
        expanded = 2 * float(np.sqrt(predicted["covariance"][-1, i, i])) / SIZE[i]
        assert number(reported[name][6]) == pytest.approx(float(predicted[name][-1]) / SIZE[i], abs=0.06 * expanded)


def test_prediction_beyond_training_is_reported_and_shaded(model, warm_ups, tmp_path):
    predicted = model.predict(warm_ups[3])
    out = predicted["outside"].values
    assert 0 < out.sum() < out.size
    html = write_report(predicted, tmp_path / "r.html").read_text(encoding="utf-8")
    text = words(html)
    assert f"{out.sum()} of {out.size} instants lie outside the training range" in text
    assert "Coloured background: outside" in text
    reported = rows(html, "Inputs outside the training range")[1:]
    by_input = predicted["outside_feature"].sum("time")
    expected = {
        str(name): str(int(n)) for name, n in zip(predicted["feature"].values, by_input.values, strict=True) if n
    }
    assert {row[0]: row[1] for row in reported} == expected
    notes = predicted.attrs["notes"]
    assert notes != [""]
    assert all(note in text for note in notes)


@pytest.mark.usefixtures("undrawn")
def test_a_time_without_an_input_has_no_prediction(model, warm_ups, tmp_path):
    part = warm_ups[2].copy(deep=True)
    values = part["temperature"].values.copy()
    values[4, list(part["sensor"].values).index("column")] = np.nan
    part["temperature"] = (part["temperature"].dims, values, part["temperature"].attrs)
    text = words(write_report(model.predict(part), tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "1 instants have no prediction" in text
    assert "24 of 25" in text
