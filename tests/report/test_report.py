"""The page is complete and self-contained, marks unknown values, and escapes hostile names."""

import base64
import hashlib
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
import xarray as xr
from coded import raises

from errormotion.datasets import build_errors
from errormotion.datasets.provenance import of
from errormotion.errors import DatasetError
from errormotion.report import provenance, write_report
from errormotion.report.document import Source
from errormotion.report.drawings.series import commanded_speed

pytestmark = pytest.mark.usefixtures("translated")

VOID = {"meta", "br", "hr", "img", "link", "input", "col", "wbr"}


class Page(HTMLParser):
    """Text, sections and attributes of a page; ``unbalanced`` holds every tag that was not closed in order."""

    def __init__(self, html):
        super().__init__()
        self.open, self.unbalanced, self.attributes, self.words, self.tags = [], [], [], [], []
        self.feed(html)
        self.close()
        self.unbalanced += self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, name, value or "") for name, value in attrs]

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.unbalanced.append(tag)

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())

    def values(self, name):
        return [value for _, attribute, value in self.attributes if attribute == name]


@pytest.fixture
def read(tmp_path):
    def write_and_read(errors, **more):
        path = write_report(errors, tmp_path / "report.html", **more)
        return Page(path.read_text(encoding="utf-8"))

    return write_and_read


@pytest.fixture(scope="module")
def drift_html(drift, tmp_path_factory):
    path = tmp_path_factory.mktemp("drift") / "report.html"
    write_report(drift, path, run={"test": "Warm-up", "operator": "J. Doe"})
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(drift_html):
    return Page(drift_html)


def test_every_tag_is_closed(page):
    assert page.unbalanced == []


def test_the_page_has_no_external_references(page, drift_html):
    assert "http:" not in drift_html
    assert "https:" not in drift_html
    assert "@import" not in drift_html
    assert not {"link", "iframe", "img", "object", "embed"} & set(page.tags)
    links = [value for name in ("href", "src", "xlink:href", "data", "action") for value in page.values(name)]
    assert all(value.startswith("#") for value in links)
    assert re.findall(r"url\((?!#)", drift_html) == []
    (script,) = re.findall(r"<script>(.*?)</script>", drift_html, re.DOTALL)
    allowed = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"default-src 'none'; img-src data:; script-src 'sha256-{allowed}'; style-src" in drift_html
    assert not re.search(r"fetch|XMLHttp|import\b|eval|innerHTML|document\.write", script)


def test_a_spindle_report_has_all_its_sections(page):
    wanted = {"summary", "iso", "drift", "temperatures", "setup", "uncertainty", "quality", "provenance"}
    assert {f"{name}-1" for name in wanted} <= set(page.values("id"))


def test_every_reference_inside_the_page_has_its_target_once(page, drift_html):
    ids = page.values("id")
    assert len(ids) == len(set(ids))
    assert set(re.findall(r"url\(#([^)]+)\)", drift_html)) <= set(ids)


def test_every_figure_is_described_in_words(page):
    described = [value for tag, name, value in page.attributes if tag == "figure" and name == "aria-label"]
    assert page.tags.count("figure") == len(described) >= 6
    assert all(len(words) > 40 for words in described)


def test_the_head_states_operator_object_and_time(page):
    for words in (
        "C-frame 610",
        "Warm-up",
        "J. Doe",
        "2026-03-02 08:15 UTC",
        "Micro-Epsilon ILD2300-2, serial number 10123",
    ):
        assert words in page.text


def test_the_iso_table_names_range_and_difference(page, drift):
    stop = np.flatnonzero(drift["spindle_speed"].values > 0)[-1]
    change = float(drift["EZ"][stop] - drift["EZ"][0]) * 1e6
    # Uncertainty 0.2 um, so 0.40 expanded, and the value to the same place.
    assert f"+{change:.2f} ± 0.40" in page.text
    for words in (
        "range",
        "difference",
        "first 60 min",
        "to the end of running (103.0 min)",
        "time constant",
        "end slope",
    ):
        assert words in page.text


def test_a_value_with_a_compensation_step_is_marked(page):
    assert "includes the step of a compensation that was switched in this interval" in page.text


def test_a_switched_compensation_is_reported_with_its_change(page):
    found = re.search(r"Z compensation off at 101.0 min: .*? stepped by \+(\d+\.\d+) ±", page.text)
    # The step is 29.3 um; the warm-up adds less than 0.02 um between the two means.
    assert float(found[1]) == pytest.approx(29.3, abs=0.1)


@pytest.mark.usefixtures("undrawn")
def test_a_mean_across_a_switched_compensation_does_not_change_its_step(read, make_drift):
    errors = make_drift(1561)  # every 4 s, one instant 4 s after the switch
    across = int(np.flatnonzero(errors["time"].values > 6060.0)[0])
    errors["EZ"][across] -= 15e-6
    found = re.search(r"Z compensation off at 101.0 min: .*? stepped by \+(\d+\.\d+) ±", read(errors).text)
    assert float(found[1]) == pytest.approx(29.3, abs=0.1)


def test_an_undetermined_freedom_is_a_dash_with_its_reason(page):
    row = re.search(r"EC ECC arcsec (.*?) a not determined by this method", page.text)
    assert row[1].replace("a", "").split() == ["—"] * 3
    assert "Not observed by this test: EC (ECC)" in page.text


@pytest.mark.usefixtures("undrawn")
def test_a_missing_iso_value_has_a_reason(read, make_drift):
    text = read(make_drift(400, minutes=30.0, temperature=False, speed=False)).text
    assert "the record is 30.0 min long, shorter than 60 min" in text
    assert "the curve is not described by one exponential" in text
    assert "No temperatures were recorded" in text
    assert "no temperature was recorded" in text
    assert "the spindle speed was not recorded" in text
    # Events after the end of the record are not part of it.
    assert "compensation off" not in text


def test_the_budget_names_its_groups_and_adds_up(page, drift):
    for name in ("beams", "reference", "expansion", "independent noise", "combined, k = 1", "expanded, k = 2"):
        assert name in page.text


def test_hostile_names_are_text(read, make_drift):
    name = '<script>alert("1")</script>&amp;{{ 7*7 }}$\\frac{'
    drift = make_drift(300, machine=name)
    drift = drift.assign_coords(sensor=[f"{name}{i}" for i in range(4)] + ["_hidden"])
    seen = read(drift, run={"operator": name}, title=name)
    assert seen.tags.count("script") == 1  # that of the page
    assert name in seen.text
    assert seen.unbalanced == []


@pytest.mark.usefixtures("undrawn")
def test_simulated_data_are_marked(read, beams, simulated_instruments):
    seen = read(beams.assign_attrs(provenance=json.dumps(of(beams) | {"instruments": simulated_instruments})))
    assert "SIMULATED DATA" in seen.text
    assert "sim://cframe/frame?seed=3" in seen.text
    # The banner is the first element.
    assert seen.text.index("SIMULATED DATA") < seen.text.index("Test report")


@pytest.mark.parametrize(
    "instrument",
    [
        {"settings": {"channels": [{"address": " SIM://cframe/x1"}]}},
        {"addresses": ["tcp://10.0.0.7", "sim://cframe/x1"]},
        {"identity": {"simulated": True}},
        {"identity": {"simulated": "true"}},
        {"address": "twin://cframe"},
        {"attributes": '[{"name": "frame", "address": "sim://cframe"}]'},
    ],
)
def test_simulation_is_detected_in_all_sources(instrument):
    assert provenance.simulated({"instruments": [{"name": "thermometer"}, instrument]})


def test_real_instruments_are_not_marked_as_simulated():
    real = {"address": "tcp://10.0.0.7", "status": "simulated_only", "identity": {"simulated": False}}
    assert provenance.simulated({"instruments": [real], "machine": "simulator of the sim:// kind"}) == ""
    assert provenance.replayed({"instruments": [real]}) == ""


def test_measured_data_have_no_banner(page):
    assert "SIMULATED" not in page.text
    assert "REPLAYED" not in page.text


@pytest.mark.usefixtures("undrawn")
def test_a_replayed_recording_is_named(read, beams):
    run = {"instruments": [{"address": "replay://frame.jsonl"}]}
    assert "REPLAYED RECORDING" in read(beams, run=run).text


def test_a_dead_channel_is_shown_as_such(read, make_drift):
    drift = make_drift(300)
    for name in ("fit_residual", "distance_mean"):
        drift[name][{"channel": 1}] = np.nan
    drift["valid_fraction"][{"channel": 1}] = 0.0
    drift["displacement"][{"level": 1}] = np.nan
    for name in ("iso_value", "iso_uncertainty"):
        drift[name].loc[{"quantity": ["X2", "Y2"]}] = np.nan
    seen = read(drift)
    assert "no valid value" in seen.text
    assert re.search(r"X2 0 % 0 % 1 104\.\d min", seen.text)
    assert "X2 could not be determined from this record" in seen.text
    assert seen.unbalanced == []


def test_the_required_part_of_a_spindle_dataset_is_sufficient(read, drift):
    bare = drift.drop_vars([name for name in drift.data_vars if name[0] != "E" and name != "covariance"])
    bare = bare.drop_dims(["channel", "sensor"], errors="ignore").drop_vars("spindle_speed")
    seen = read(bare)
    assert "The result contains no ISO 230-3 values." in seen.text
    assert "does not contain the geometry" in seen.text
    assert seen.unbalanced == []


@pytest.mark.parametrize("instants", [0, 1])
def test_a_record_with_few_values_has_a_page(read, drift, instants):
    assert read(drift.isel(time=slice(0, instants))).unbalanced == []


@pytest.mark.usefixtures("undrawn")
def test_remarks_of_the_method_and_lost_samples_are_reported(read, drift):
    raw = xr.Dataset(attrs={"dropped": 1234, "invalid": '{"out_of_range": 7}'})
    text = read(drift.assign_attrs(notes=["Sensor X1 was cold."]), raw=raw).text
    assert "Sensor X1 was cold." in text
    assert "dropped samples 1 234, invalid because of out of range 7" in text


def test_the_page_of_a_long_record_is_small(make_drift, tmp_path):
    path = write_report(make_drift(12_000), tmp_path / "report.html")
    assert path.stat().st_size < 2_000_000


@pytest.mark.usefixtures("undrawn")
def test_an_older_report_is_replaced_without_remains(beams, tmp_path):
    path = tmp_path / "report.html"
    path.write_text("old")
    assert write_report(beams, path) == path
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]


def test_the_dataset_is_not_changed(beams, tmp_path):
    before = beams.copy(deep=True)
    write_report(beams, tmp_path / "report.html")
    xr.testing.assert_identical(beams, before)


def test_a_beam_detection_is_reported_with_both_constructions(read, beams):
    seen = read(beams)
    assert {"beams-1", "nominal-1", "constructions-1", "quality-1", "provenance-1"} <= set(seen.values("id"))
    assert "4 of 5 beams were determined" in seen.text
    assert "Not determined: X2" in seen.text
    assert "X2 —" in seen.text
    assert seen.unbalanced == []
    # Each coordinate of the origin by circles and line was increased by 0.7 um: 0.7 sqrt(3) = 1.21.
    assert "+0.70 +0.70 +0.70 1.21" in seen.text
    # X1 deviates by 0.1 mm from nominal.
    assert re.search(r"X1 0\.00 ± 0\.\d+ \+100\.00 ± 0\.\d+ 0\.00", seen.text)


@pytest.mark.parametrize(("dims", "shape"), [(("position",), (21,)), (("time", "position"), (3, 8)), ((), ())])
def test_any_component_has_a_report(read, dims, shape):
    rng = np.random.default_rng(3)
    values = rng.normal(0, 1e-6, (*shape, 6))
    values[..., 5] = np.nan
    axes = {"time": 3600.0 * np.arange(3), "position": np.linspace(0, 0.5, shape[-1] if shape else 1)}
    errors = build_errors(
        values,
        np.broadcast_to(np.eye(6) * 1e-14, (*shape, 6, 6)),
        dims=dims,
        coords={name: axes[name] for name in dims},
        component="X",
        machine="gantry",
        frame="machine",
        functional_point=[0, 0, 0],
        reference="cold",
        method="other",
        method_version="1",
        provenance={"settings": {}},
    )
    seen = read(errors)
    assert "EXX" in seen.text
    assert "not observed" in seen.text
    assert seen.unbalanced == []


def test_several_results_have_several_chapters(read, drift, beams):
    seen = read([beams, drift])
    assert "1 Detection of the laser beams" in seen.text
    assert "2 Thermal drift of the spindle" in seen.text
    ids = seen.values("id")
    assert len(ids) == len(set(ids))


def test_a_dataset_without_errors_is_refused(tmp_path):
    with raises("report.dataset.variables"):
        write_report(xr.Dataset(), tmp_path / "report.html")
    with raises("report.no_datasets"):
        write_report([], tmp_path / "report.html")
    assert list(tmp_path.iterdir()) == []


def test_a_model_is_refused_with_the_commands_that_show_it(tmp_path):
    model = xr.Dataset(attrs={"schema": "errormotion.model.thermal/1"})
    with pytest.raises(DatasetError, match="errormotion model check MODEL ERRORS"):
        write_report(model, tmp_path / "report.html")


def test_the_speed_over_time_is_the_commanded_one_of_the_schedule(drift):
    schedule = [{"at": 600.0, "spindle_speed": 12000.0}, {"at": 3000.0, "spindle_speed": 0.0}, {"at": 10.0}]
    source = Source(drift, provenance={"settings": {"schedule": schedule}})
    time, speed = drift["time"].values, commanded_speed(source)
    assert (speed[time <= 600] == 0).all()
    assert (speed[(time > 600) & (time <= 3000)] == 12000).all()
    assert (speed[time > 3000] == 0).all()
    assert commanded_speed(Source(drift)) is None
