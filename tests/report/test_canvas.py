"""Figures show all visible features, and have no external references in a page."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

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


def test_a_gap_is_drawn_as_a_gap():
    t = np.arange(10_000.0)
    y = np.ones(10_000)
    y[4000:5000] = np.nan
    thin_t, thin_y = canvas.decimate(t, y)
    inside = (thin_t > 4050) & (thin_t < 4950)
    assert inside.any()
    assert np.isnan(thin_y[inside]).all()


def test_short_curves_are_not_changed():
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


def test_a_power_of_ten_is_at_the_other_end_of_the_title():
    def paint(figure):
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1e-9])
        axes.set_title("Position")

    svg = str(canvas.draw(paint, "k", 2.0))
    assert re.search(r"text-anchor: end[^>]*>1e−9<", svg)


def test_svg_has_no_address_and_no_unused_identifier():
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


def test_a_picture_inside_a_drawing_is_embedded():
    def paint(figure):
        axes = figure.subplots()
        figure.colorbar(axes.scatter([0, 1], [0, 1], c=[0, 1]))  # many colours: matplotlib embeds a picture

    svg = str(canvas.draw(paint, "k", 2.0))
    assert re.findall(r'href="(data:image/png;base64,|#k-)', svg).count("data:image/png;base64,") == 1
    assert "#k-data:" not in svg


def test_a_drawn_curve_contains_values_and_uncertainty_for_the_page():
    t, values = np.linspace(0, 50, 40), np.sin(np.linspace(0, 6, 40)) * 7
    values[11] = np.nan
    expanded = 0.1 + 0.01 * t

    def paint(figure):
        axes = canvas.stack(figure, [1.5])[0]
        canvas.curve(axes, t, values, expanded, colour=canvas.BLUE, name="EX <b>")
        axes.axhline(0)
        axes.set_xlabel("time / min")
        axes.set_title("Displacements / µm")

    root = ElementTree.fromstring(str(canvas.draw(paint, "k", 2.2)))
    (panel,) = [each for each in root.iter("g") if each.get("class") == "panel"]
    (curve,) = [each for each in panel.iter("g") if each.get("data-curve") is not None]
    left, top, wide, high = map(float, panel.get("data-box").split())
    x0, x1 = map(float, panel.get("data-x").split())
    y0, y1 = map(float, panel.get("data-y").split())
    drawn = np.array(re.findall(r"(-?[\d.]+) (-?[\d.]+)", curve.find("path").get("d")), float)
    known = np.isfinite(values)
    # A hundredth of a point on the page.
    assert x0 + (drawn[:, 0] - left) / wide * (x1 - x0) == pytest.approx(t[known], abs=0.01 * (x1 - x0) / wide)
    assert y1 - (drawn[:, 1] - top) / high * (y1 - y0) == pytest.approx(values[known], abs=0.01 * (y1 - y0) / high)
    assert np.array(curve.get("data-u").split(), float) == pytest.approx(expanded[known], rel=6e-3)
    assert (curve.get("data-name"), curve.get("data-unit")) == ("EX <b>", "µm")
    assert (panel.get("data-x-name"), panel.get("data-x-unit"), panel.get("data-zoom")) == ("time", "min", "")
    assert len([each for each in root.iter("g") if (each.get("class") or "").startswith("tick")]) > 5


def test_limits_near_a_curve_are_lines_and_others_are_named():
    def paint(figure):
        axes = figure.subplots()
        axes.plot([0, 1], [0, 10])
        canvas.limit_lines(axes, [("EX", -5.0, 12.0), ("EY", -12000.0, 12.0), ("EZ", -np.inf, np.inf)])
        low, high = axes.get_ylim()
        assert low < -5
        assert 12 < high < 20

    svg = str(canvas.draw(paint, "k", 2.0))
    assert "limit of EX, EY" in svg
    assert "limits outside of the graph: EY −1.2e+04" in svg
    assert "EZ" not in svg


def test_numbers_of_a_narrow_panel_do_not_overlap():
    kept = []

    def paint(figure):
        kept.append(figure.add_axes((0.1, 0.2, 0.13, 0.7)))
        kept[0].plot([0, 120], [0, 1])

    canvas.draw(paint, "k", 2.0)
    low, high = kept[0].get_xlim()
    ticks = [tick for tick in kept[0].get_xticks() if low <= tick <= high]
    points = 72 * canvas.WIDTH * 0.13
    assert len(ticks) >= 2
    assert points * np.diff(ticks).min() / (high - low) > 3 * 4.6  # three digits
