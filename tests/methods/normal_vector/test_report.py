"""The chapter of a warm-up by probing: the dataset's numbers, what is not seen, what was left out, and nothing else."""

import re
from functools import cache
from html import unescape
from xml.etree import ElementTree

import numpy as np
import pytest
import xarray as xr

from errormotion.methods.normal_vector import NormalVector, simulation
from errormotion.methods.normal_vector.report import chapters
from errormotion.methods.normal_vector.report.balls import MISSING, MOVED, WRONG, displacement, well_known
from errormotion.methods.normal_vector.report.drawings import balls
from errormotion.report import write_report
from errormotion.report.document import Source
from errormotion.report.drawings.timeline import clock
from errormotion.report.page.language import Catalogue
from errormotion.report.text import fixed
from errormotion.twin import Event, VirtualMachine

pytestmark = pytest.mark.usefixtures("translated")

UM, ARCSEC = 1e-6, np.pi / 180 / 3600
HEADINGS = [
    "Errors and temperatures",
    "Balls",
    "Touches and residuals",
    "Published normals compared with the fit",
    "Temperature sensors",
    "Uncertainty",
    "Data quality",
    "Provenance",
]


@cache
def warm_up(kind="gantry", **more):
    """Return the raw data of an hour and a half with a cycle every ten minutes."""
    machine = VirtualMachine(kind, seed=3)
    machine.start([Event(0.0, 6000.0), Event(2400.0, 12000.0)])
    return simulation.raw(machine, np.arange(0.0, 5401.0, 600.0), seed=5, **more)


@cache
def clean():
    raw = warm_up()
    return NormalVector().identify(raw), raw


@cache
def troubled():
    """A ball that moves before cycle 5, touches that are missing, and one that is wrong by 20 µm."""
    raw = warm_up(moved=(1, 3000.0, (30 * UM, -20 * UM, 10 * UM)), missing=0.03).copy(deep=True)
    raw["touch"][3, 2, 1] += 20 * UM
    return NormalVector().identify(raw), raw


@cache
def cframe():
    raw = warm_up("cframe")
    return NormalVector().identify(raw, NormalVector.Settings(tool_axes="Z")), raw


@cache
def page(which, folder):
    errors, raw = which()
    return write_report(errors, folder / f"{which.__wrapped__.__name__}.html", raw=raw).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("report")


def words(html):
    text = re.sub(r"<[^>]+>", " ", re.sub(r"<style>.*?</style>", "", html, flags=re.S))
    return re.sub(r"\s+", " ", unescape(text))


def rows(html, caption):
    """Return the rows of the table whose caption begins so, as lists of text."""
    table = next(t for t in re.findall(r"<table.*?</table>", html, re.S) if caption in words(t))
    found = re.findall(r"<tr>(.*?)</tr>", table, re.S)
    return [[words(cell).strip() for cell in re.findall(r"<t[hd].*?</t[hd]>", row, re.S)] for row in found]


def number(text):
    return float(text.replace("−", "-").replace("+", ""))


def test_all_sections_are_in_order(folder):
    html = page(clean, folder)
    places = [html.index(f"<h2>{title}</h2>") for title in HEADINGS]
    assert places == sorted(places)
    assert html.count("<figure") == 5  # no map: the twin says no places


def test_page_needs_no_network_and_runs_no_script(folder):
    html = page(troubled, folder)
    assert html.count("<script") == 1  # that of the page
    assert not re.search(r"(?:src|href)=[\"']https?:", html)
    assert "<image" not in html
    for svg in re.findall(r"<svg.*?</svg>", html, re.S):
        ElementTree.fromstring(svg)


def test_errors_in_the_table_are_those_of_the_dataset(folder):
    errors, _ = clean()
    found = {row[0]: row for row in rows(page(clean, folder), "The six errors")}
    for i, name in enumerate(("EX", "EY", "EZ", "EA", "EB", "EC")):
        size = UM if i < 3 else ARCSEC
        value, expanded = found[name][6].split("±")
        decimals = len(expanded.split(".")[1])
        assert value.strip() == fixed(float(errors[name][-1]) / size, decimals, signed=True)
        sigma = float(np.sqrt(errors["covariance"][-1, i, i]))
        # The expanded uncertainty is stated with two digits.
        assert number(expanded) == pytest.approx(2 * sigma / size, rel=0.06)
        assert number(found[name][3]) == pytest.approx(float(errors[name].max()) / size, abs=0.006)
        assert found[name][7] == "10 of 10"


def test_displacements_of_the_balls_are_those_of_the_dataset(folder):
    errors, _ = clean()
    moved = errors["ball_displacement"].values / UM
    found = rows(page(clean, folder), "Apparent centres of the balls")[2:]
    assert [row[0] for row in found] == ["B1", "B2", "B3", "B4"]
    for row, own in zip(found, moved.transpose(1, 0, 2), strict=True):
        assert [number(cell.split("±")[0]) for cell in row[4:7]] == pytest.approx(own[-1], abs=0.06)
        assert number(row[7]) == pytest.approx(np.linalg.norm(own, axis=1).max(), abs=0.06)
        assert row[8] == "no"


def test_enlargement_that_is_reported_is_the_one_that_is_drawn():
    errors, _ = clean()
    (figure,) = balls(Source(errors), "k")
    factor = int(re.search(r"magnified (\d[\d\u202f]*) times", figure.caption)[1].replace("\u202f", ""))
    span = np.linalg.norm(np.ptp(errors["centre"].values[0], axis=0))
    longest = np.linalg.norm(displacement(errors), axis=2).max()
    assert 0.02 * span < factor * longest < 0.25 * span
    assert f"{fixed(longest / UM, 1)} µm" in figure.caption


def test_cost_of_the_normals_is_a_number_and_a_curve(folder):
    errors, _ = clean()
    html = page(clean, folder)
    loss = errors["normals_loss"].values
    found = {row[0]: row for row in rows(html, "The published normals")}
    for i, name in enumerate(("EX", "EY", "EZ", "EA", "EB", "EC")):
        assert number(found[name][4]) == pytest.approx(np.nanmedian(loss[:, i]), abs=0.006)
        assert number(found[name][5]) == pytest.approx(np.nanmax(loss[:, i]), abs=0.006)
    assert "Standard uncertainty by the normals over that of the fit" in words(html)


def test_residuals_are_counted_by_ball_and_by_reason(folder):
    errors, _ = troubled()
    out, residual = errors["left_out"].values, errors["residual"].values
    found = rows(page(troubled, folder), "The readings of each ball")[2:]
    for i, row in enumerate(found[:-1]):
        counted = [int((out[:, i] == code).sum()) for code in (0, MISSING, WRONG, MOVED)]
        assert [int(cell) for cell in row[1:5]] == counted
        used = residual[:, i][out[:, i] == 0] / UM
        assert number(row[6]) == pytest.approx(np.sqrt(np.mean(used**2)), abs=6e-4)
    assert found[-1][0] == "all"
    assert int(found[-1][3]) == 1
    assert (out == MISSING).sum() > 0


def test_ball_that_moved_is_named_and_marked(folder):
    html = words(page(troubled, folder))
    assert "Moved on the table: B2." in html
    assert "B2 (moved)" in html
    assert "from cycle 5" in html
    assert "Red, dashed: B2" in html


def test_remarks_of_the_method_and_flags_of_the_probe_are_reported(folder):
    errors, raw = troubled()
    html = words(page(troubled, folder))
    for note in errors.attrs["notes"]:
        assert Catalogue("en").word(note) in html
    flagged = int((raw["touch_flag"] == 1).sum())
    assert f"Flagged by the probe: no trip: {flagged} (the first of " in html
    assert "The probe flagged no touch." in words(page(clean, folder))


@pytest.mark.parametrize("variant", ["touches", "centres"])
@pytest.mark.parametrize("noise", ["stated", "half", "unknown"])
def test_notes_of_the_result_are_in_the_german_catalogue(variant, noise):
    """Outliers, a moved ball with its rivals, missing readings, and every statement on the noise."""
    raw = warm_up("cframe", balls=3, moved=(1, 3000.0, (4 * UM, -3 * UM, 3 * UM)), variant=variant)
    raw = raw.copy(deep=True)
    name, spread = ("touch", "touch_noise") if variant == "touches" else ("centre", "centre_covariance")
    raw[name][(2, 0, 1) if variant == "touches" else (2, 0)] += 40 * UM
    if noise == "unknown":
        raw = raw.drop_vars(spread)
    elif noise == "half":
        raw[spread] = raw[spread] / 4
    found = [NormalVector().identify(raw, NormalVector.Settings(noise=how)) for how in ("auto", "stated")]
    german = Catalogue("de", [NormalVector.texts("de")])
    for note in {note for errors in found for note in errors.attrs["notes"]}:
        german(note)
    assert not german.missing


def test_centre_that_lost_its_top_touch_is_not_drawn_as_a_displacement():
    errors = clean()[0].copy(deep=True)
    assert well_known(errors).all()
    errors["centre_covariance"].loc[{"time": errors["time"][4]}][2, 2, 2] = (30 * UM) ** 2
    errors["ball_displacement"].loc[{"time": errors["time"][4]}][2, 2] = 500 * UM
    assert not well_known(errors)[4, 2]
    (figure,) = balls(Source(errors), "k")
    assert "500" not in figure.caption
    assert "Not drawn: 1 centres" in figure.caption


@pytest.mark.usefixtures("undrawn")
def test_undetermined_freedom_is_a_dash_with_its_reason(folder):
    html = page(cframe, folder)
    row = next(row for row in rows(html, "The six errors") if row[0] == "EC")
    assert row[2].startswith("—")
    assert row[7] == "0 of 10"
    text = words(html)
    assert "Not determined: EC. Reported as unknown, not as zero." in text
    assert "only Z carry the tool" in text
    assert "The result contains no published normals; the reason is stated under data quality." in text


def test_temperatures_and_speed_share_the_time_axis_of_the_errors(folder):
    html = page(clean, folder)
    figure = html[html.index('id="errors-1"') : html.index("</figure>", html.index('id="errors-1"'))]
    for title in ("Displacements / µm", "Rotations / arcsec", "Temperatures / °C", "Mean spindle speed / (1/min)"):
        assert title in figure
    assert figure.count("time / min") == 1
    for sensor in clean()[0]["sensor"].values:
        assert str(sensor) in figure


@pytest.mark.usefixtures("undrawn")
def test_sensors_are_at_the_positions_of_their_thermometer(tmp_path):
    errors, raw = clean()
    run = {
        "instruments": [
            {"name": "thermo", "settings": {"places": {"head": [0.2, 0.3, 1.1], "bed": None, "motor": [1.0, 0.3, 1.2]}}}
        ]
    }
    html = write_report(errors, tmp_path / "r.html", raw=raw, run=run).read_text(encoding="utf-8")
    found = {row[0]: row for row in rows(html, "Temperatures in °C")}
    assert found["head"][1] == "200, 300, 1100"
    assert found["bed"][1].startswith("—")
    values = errors["temperature"].sel(sensor="head").values
    assert [number(cell) for cell in found["head"][2:6]] == pytest.approx(
        [values[0], values.min(), values.max(), values[-1]], abs=0.06
    )
    text = words(html)
    assert "Positions of the sensors on the machine" in text
    assert re.search(r"Position unknown: .*bed", text)


@pytest.mark.usefixtures("unprinted")
def test_unknown_temperature_is_not_a_number(tmp_path):
    errors, raw = clean()
    values = errors["temperature"].values.copy()
    values[:, 0] = np.nan
    values[3:5, 1] = np.nan
    gone = errors.assign_coords(temperature=(("time", "sensor"), values, errors["temperature"].attrs))
    html = write_report(gone, tmp_path / "r.html", raw=raw).read_text(encoding="utf-8")
    first, second = rows(html, "Temperatures in °C")[1:3]
    assert first[7].startswith("100 %")
    assert first[2].startswith("—")
    assert second[7].startswith("20.00 %")
    assert html.count("stroke='#B3261E'") == 2  # one red bar in each of the two small curves
    assert f"Without a valid reading: {first[0]}" in words(html)


@pytest.mark.usefixtures("undrawn")
def test_result_by_the_normals_is_labelled(tmp_path):
    raw = warm_up()
    errors = NormalVector().identify(raw, NormalVector.Settings(procedure="normals"))
    text = words(write_report(errors, tmp_path / "r.html", raw=raw).read_text(encoding="utf-8"))
    assert "The result of this page is that of the published normals" in text
    assert "Normals minus fit" not in text


@pytest.mark.usefixtures("unprinted")
def test_result_without_any_of_its_extras_still_has_a_page(tmp_path):
    errors, _ = clean()
    bare = errors[["EX", "EY", "EZ", "EA", "EB", "EC", "covariance"]].drop_vars(
        ["temperature", "spindle_speed", "feed", "sensor", "ball", "direction", "direction_", "cycle_time"],
        errors="ignore",
    )
    text = words(write_report(bare, tmp_path / "r.html").read_text(encoding="utf-8"))
    assert "The result contains no displacements of balls" in text
    assert "The result contains no residuals" in text
    assert "No temperatures were recorded." in text


@pytest.mark.usefixtures("unprinted")
def test_cycles_that_are_all_unknown_are_reported(tmp_path):
    errors, raw = clean()
    gone = errors.copy(deep=True)
    for name in ("EX", "EY", "EZ", "EA", "EB", "EC"):
        gone[name][:] = np.nan
    gone["covariance"][:] = np.nan
    gone = gone.drop_vars(["influence"])
    text = words(write_report(gone, tmp_path / "r.html", raw=raw).read_text(encoding="utf-8"))
    assert "the errors of 10 are unknown" in text
    assert "No cycle determines the errors" in text


@pytest.mark.usefixtures("undrawn")
def test_flags_of_another_raw_dataset_are_not_used():
    errors, raw = clean()
    for given, stated in ((raw, True), (raw.isel(time=slice(0, 4)), False), (xr.Dataset(), False), (None, False)):
        (part,) = chapters(Source(errors, given))
        words = [block.text for section in part.sections for block in section.blocks if hasattr(block, "text")]
        assert ("The probe flagged no touch." in words) is stated


@pytest.mark.parametrize(("span", "unit"), [(60.0, "s"), (3600.0, "min"), (86400.0, "h"), (30 * 86400.0, "days")])
def test_time_axis_has_the_unit_that_suits_it(span, unit):
    time = clock(np.linspace(0, span, 5))
    assert time.unit == unit
    assert time.values[-1] * time.size == pytest.approx(span)
