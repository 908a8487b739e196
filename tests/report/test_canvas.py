"""Figures keep what the eye would see, and stand in a page without reaching out of it."""

import re
from xml.etree import ElementTree

import numpy as np

from errormotion.report import canvas


def test_a_single_spike_survives_thinning():
    t = np.arange(100_000.0)
    y = np.sin(t / 9000)
    y[61_234] = 7.0
    thin_t, thin_y = canvas.decimate(t, y)
    assert thin_t.size < 1000
    assert thin_y.max() == 7.0
    assert thin_t[np.argmax(thin_y)] == 61_234
    assert (np.diff(thin_t) > 0).all()


def test_a_gap_stays_a_gap():
    t = np.arange(10_000.0)
    y = np.ones(10_000)
    y[4000:5000] = np.nan
    thin_t, thin_y = canvas.decimate(t, y)
    inside = (thin_t > 4050) & (thin_t < 4950)
    assert inside.any()
    assert np.isnan(thin_y[inside]).all()


def test_short_curves_are_left_as_they_are():
    t, y = np.arange(5.0), np.array([1.0, np.nan, 3.0, 2.0, 1.0])
    assert canvas.decimate(t, y)[1] is y


def test_a_thinned_band_covers_the_full_one():
    rng = np.random.default_rng(0)
    t = np.arange(20_000.0)
    low, high = rng.normal(-2, 1, t.size), rng.normal(2, 1, t.size)
    thin_t, lowest, highest = canvas.envelope(t, low, high)
    assert lowest.min() == low.min()
    assert highest.max() == high.max()
    assert thin_t[[0, -1]].tolist() == [0.0, 19_999.0]


def test_names_that_look_like_mathematics_or_markup_are_drawn_as_written():
    def paint(figure):
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1])
        axes.set_title(r"$\frac{1}{</text><script>alert(1)</script> 主軸")

    svg = str(canvas.draw(paint, "k", 2.0))
    assert r"$\frac{1}{&lt;/text&gt;&lt;script&gt;" in svg
    assert "<script" not in svg
    assert "主軸" in svg


def test_svg_has_no_address_and_no_loose_identifier():
    def paint(figure):
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], marker="o")

    one, other = (str(canvas.draw(paint, key, 2.0)) for key in ("one", "other"))
    assert "http" not in one
    assert "<metadata" not in one
    assert "<style" not in one
    ids = re.findall(r' id="([^"]+)"', one)
    used = set(re.findall(r"#([^)\"]+)", one)) - {"ffffff"}
    assert ids
    assert set(ids) <= used
    assert not set(ids) & set(re.findall(r' id="([^"]+)"', other))
    ElementTree.fromstring(one)


def test_a_picture_inside_a_drawing_is_kept_in_it():
    def paint(figure):
        axes = figure.subplots()
        figure.colorbar(axes.scatter([0, 1], [0, 1], c=[0, 1]))  # many colours: matplotlib embeds a picture

    svg = str(canvas.draw(paint, "k", 2.0))
    assert re.findall(r'href="(data:image/png;base64,|#k-)', svg).count("data:image/png;base64,") == 1
    assert "#k-data:" not in svg
