"""The chapter of a circular test: figures with limits, polar plot, errors of the axes; in field units and German."""

import re
from html import unescape

import numpy as np
import pytest

from errormotion.datasets.results.merit import figures_of
from errormotion.methods.circular_test import CircularTest, CircularTestSettings
from errormotion.report import write_report
from errormotion.report.text import rounded

pytestmark = pytest.mark.usefixtures("translated")

TURN = 2 * np.pi


@pytest.fixture(scope="module")
def measured():
    """Return the result of a test in which something is missing, with limits, noisy, and set up badly."""
    settings = CircularTestSettings(samples=540, places=60, circular_deviation_limit=5e-6, hysteresis_limit=10e-6)
    raw, _ = CircularTest().simulate(settings, seed=1)
    raw["length_noise"] = raw["length_noise"].copy(data=0.05e-6)
    raw["length"] = raw["length"].where((raw["angle"] % TURN < TURN / 6) | (raw["angle"] % TURN > TURN * 11 / 60))
    return CircularTest().identify(raw.drop_vars("expansion"), settings)


@pytest.fixture(scope="module")
def page(measured, tmp_path_factory):
    out = tmp_path_factory.mktemp("circular_test") / "report.html"
    write_report(measured, out)
    return out.read_text(encoding="utf-8").partition("<body>")[2]


@pytest.fixture(scope="module")
def text(page):
    return unescape(" ".join(re.sub(r"<[^>]+>", " ", page).split()))


def test_the_figures_have_their_uncertainty_and_limit(text, measured):
    for figure in figures_of(measured):
        value, U = rounded(1e6 * figure.value, 1e6 * figure.expanded_uncertainty, signed=False)
        limit = "" if figure.limit is None else f" limit {1e6 * figure.limit:.3g}"
        assert f"{figure.name} {value} µm ± {U} µm (k = 2){limit}" in text
    assert "H XY, circular hysteresis" in text


def test_the_paths_are_drawn_on_circles(page, text):
    assert "Radial deviation on the circle in plane XY, enlarged, positive outward" in text
    polar = page.partition('aria-label="Polar plots')[2].partition("</figure>")[0]
    assert "CCW" in polar


def test_the_errors_of_the_axes_are_those_of_the_dataset(text, measured):
    value, u = float(measured["parameters"][0]), float(measured["parameter_covariance"][0, 0]) ** 0.5
    shown, U = rounded(1e6 * value, 2e6 * u, signed=True)
    assert f"squareness of Y to X µrad {shown} ± {U}" in text
    assert "Largest contributions to the circular deviation: squareness of Y to X, " in text


def test_the_notes_are_shown(text):
    assert "Readings scatter by 0." in text
    assert "of 120 sectors of the circles have no reading" in text
    assert "The temperature of the bar is not corrected" in text
