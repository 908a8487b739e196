"""The chapter of an R-test: location errors with U, polar plots, curves, reliability; in field units and German."""

import csv
import re
from html import unescape

import numpy as np
import pytest

from errormotion.datasets.results.merit import figures_of
from errormotion.methods.r_test import RTest, RTestSettings
from errormotion.report import Form, write_report
from errormotion.report.document import Source
from errormotion.report.text import rounded
from errormotion.report.write import chapters

pytestmark = pytest.mark.usefixtures("translated")

ARCSEC = np.pi / 180 / 3600


@pytest.fixture(scope="module")
def measured():
    """Return raw data and the result of a test with three spheres, whose nest has a large uncertainty."""
    settings = RTestSettings(spheres=3, angles=24, nest_uncertainty=6e-6)
    raw, _ = RTest().simulate(settings, seed=1)
    return raw, RTest().identify(raw, settings)


@pytest.fixture(scope="module")
def folder(measured, tmp_path_factory):
    raw, errors = measured
    out = tmp_path_factory.mktemp("r_test")
    write_report(errors, out / "report.html", raw=raw, form=Form(also=("csv",)))
    return out


@pytest.fixture(scope="module")
def page(folder):
    body = (folder / "report.html").read_text(encoding="utf-8").partition("<body>")[2]
    return unescape(" ".join(re.sub(r"<[^>]+>", " ", body).split()))


def test_location_errors_have_their_uncertainty(page, measured):
    figures = {each.name: each for each in figures_of(measured[1])}
    for name in ("EX0C", "EY0C", "EA0C", "EB0C"):
        size = 1e-6 if name[1] in "XYZ" else ARCSEC
        value, U = rounded(figures[name].value / size, figures[name].expanded_uncertainty / size, signed=False)
        unit = "µm" if name[1] in "XYZ" else "arcsec"
        assert f"{name} {value} {unit} ± {U} {unit} (k = 2)" in page
        assert re.search(rf"{name}, (offset|rotation) of the axis average line \w+ [XY] {value} ± {U}", page)


def test_the_source_of_a_large_uncertainty_is_named(page):
    # U of the offsets is 12 um, that of the nest's zero, against values of about 20 and -15 um.
    assert "Its largest source is 'zero of the nest' with 100 % of the variance: a smaller uncertainty" in page


def test_error_motions_are_drawn_on_circles_and_as_curves(page):
    assert "Error motions of axis C over the angle, enlarged, relative to its average line." in page
    assert "Error motions of axis C over the angle, actual minus commanded. Bands: expanded uncertainty, k = 2." in page
    assert "angle / °" in page


def test_data_that_no_instrument_measured_are_marked(page):
    assert page.index("SIMULATED DATA") < page.index("R-test of rotary axis C")


def test_the_reliability_of_the_readings_is_a_table(folder, measured):
    (file,) = [each for each in (folder / "report-tables").iterdir() if "data-quality" in each.name]
    head, *rows = csv.reader(file.read_text(encoding="utf-8-sig").splitlines())
    assert head == ["sensor", "residual: rms / µm", "residual: largest / µm", "redundancy: lowest",
                    "smallest error / µm", "left out"]  # fmt: skip
    readings = [row for row in rows if row[0].startswith("sensor")]
    assert len(readings) == 9
    residual = measured[1]["residual"].transpose("sphere", "sensor", "angle").values.reshape(9, -1)
    expected = 1e6 * np.sqrt(np.mean(residual**2, axis=1))
    np.testing.assert_allclose([float(row[1]) for row in readings], expected, rtol=0.005)


def test_a_test_with_one_sphere_states_what_it_does_not_determine():
    settings = RTestSettings(axis="A", spheres=1, angles=12)
    errors = RTest().identify(RTest().simulate(settings, seed=1)[0], settings)
    (part,) = chapters(Source(errors))
    assert "Not determined: EAA, EBA and ECA. Reported as unknown, not as zero." in part.summary
    assert [each.label for each in part.key_figures] == ["EY0A", "EZ0A"]


def test_a_plan_has_the_generic_chapter():
    (part,) = chapters(Source(RTest().plan(RTestSettings())))
    assert part.title == "Errors of component C"
    assert not any("large against" in words for words in part.summary)
