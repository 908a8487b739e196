"""The chapter of a spindle: values with U, polar plots with the extremes of all turns; in field units and German."""

import re
from html import unescape

import pytest

from errormotion.datasets.results.merit import figures_of
from errormotion.methods.spindle_error_motion import SpindleErrorMotion, SpindleErrorMotionSettings
from errormotion.report import write_report
from errormotion.report.text import rounded

pytestmark = pytest.mark.usefixtures("translated")


@pytest.fixture(scope="module")
def measured():
    """Return the result of a test with notes: nothing is known about the artefact, and readings are missing."""
    settings = SpindleErrorMotionSettings(turns=16, sample_rate=3000.0, places=48, radial_limit=0.3e-6)
    raw, _ = SpindleErrorMotion().simulate(settings, seed=1)
    raw["displacement"][77, 1] = float("nan")
    return SpindleErrorMotion().identify(raw.drop_vars(["roundness", "position_uncertainty"]), settings)


@pytest.fixture(scope="module")
def page(measured, tmp_path_factory):
    out = tmp_path_factory.mktemp("spindle_error_motion") / "report.html"
    write_report(measured, out)
    return out.read_text(encoding="utf-8").partition("<body>")[2]


@pytest.fixture(scope="module")
def text(page):
    return unescape(" ".join(re.sub(r"<[^>]+>", " ", page).split()))


def test_the_values_have_their_uncertainty_and_limit(text, measured):
    figures = {each.name: each for each in figures_of(measured)}
    figure = figures["synchronous radial, rotating"]
    value, U = rounded(1e6 * figure.value, 1e6 * figure.expanded_uncertainty, signed=False)
    assert f"synchronous radial, rotating {value} µm ± {U} µm (k = 2) limit 0.3" in text
    assert "asynchronous axial, largest range at one angle over all turns" in text


def test_the_mean_and_the_extremes_of_all_turns_are_drawn_on_circles(page):
    polar = page.partition('aria-label="Polar plots')[2].partition("</figure>")[0]
    for name in ("radial, rotating", "radial, fixed X", "axial", "tilt, rotating"):
        assert name in polar
    assert "max" in polar


def test_the_notes_are_shown(text):
    assert "The asynchronous error motion is that of 16 turns" in text
    assert "The roundness deviation of the artefact is not stated; 50 nm is assumed." in text
    assert "1 of " in text
