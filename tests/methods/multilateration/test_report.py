"""Chapter of a multilateration: sections, undetermined freedoms, and missing variables."""

import re
from functools import cache
from html import unescape
from xml.etree import ElementTree

import numpy as np
import pytest
import xarray as xr

from errormotion.datasets import build_errors, provenance
from errormotion.methods.multilateration import Multilateration, simulation
from errormotion.methods.multilateration.report import chapters
from errormotion.methods.multilateration.report.network import longest, network, thinned
from errormotion.report import write_report
from errormotion.report.document import Source
from errormotion.report.drawings.turntable import Ellipsoids, Lines, Scene, camera, draw, enlargement
from errormotion.twin import VirtualMachine

pytestmark = pytest.mark.usefixtures("translated")

UM = 1e-6
WRONG = 320 * UM
HEADINGS = [
    "Errors of the volume",
    "Undetermined freedoms",
    "Stations",
    "Uncertainty",
    "Errors of the axes",
    "Readings",
    "Provenance",
]


@cache
def measured():
    """Return a result with its raw data, with missing readings and an outlier of 0.32 mm."""
    machine = VirtualMachine("cframe", seed=3)
    raw = simulation.raw(machine, simulation.target_grid(machine, (4, 4, 3)), seed=1, missing=0.02)
    raw["displacement"][1, 20] += WRONG
    return Multilateration().identify(raw), raw


def bare(m=12, **extras):
    """Return a result with only the errors of targets at unknown positions."""
    rng = np.random.default_rng(4)
    values = np.full((m, 6), np.nan)
    values[:, :3] = 5 * UM * rng.normal(size=(m, 3))
    covariance = np.full((m, 6, 6), np.nan)
    covariance[:, :3, :3] = UM**2 * np.eye(3)
    return build_errors(
        values,
        covariance,
        dims=("target",),
        coords={},
        component="tool",
        machine="C-frame",
        frame="machine",
        functional_point=[0, 0, 0],
        reference="best rigid fit",
        method="multilateration",
        method_version="1",
        provenance=provenance.make({}, None, []),
        extras={name: xr.DataArray(v, dims=dims) for name, (dims, v) in extras.items()},
    )


def page(errors, tmp_path, **more):
    return write_report(errors, tmp_path / "r.html", **more).read_text(encoding="utf-8")


def words(html):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", re.sub(r"<style>.*?</style>", "", html, flags=re.S)))


@pytest.fixture(scope="module")
def html(tmp_path_factory):
    """Return the page of a result whose first station has a name with markup."""
    errors, raw = measured()
    names = ["<b>&'S1", *errors["station"].values[1:].tolist()]
    return page(errors.assign_coords(station=names), tmp_path_factory.mktemp("report"), raw=raw)


def test_all_sections_are_in_order(html):
    places = [html.index(f"<h2>{title}</h2>") for title in HEADINGS]
    assert places == sorted(places)
    assert html.count("<figure") == 9


def test_page_requires_no_network_and_no_script(html):
    assert html.count("<script") == 1  # that of the page
    assert not re.search(r"(?:src|href)=[\"']https?:", html)
    assert "<image" not in html  # a picture in the picture would not pass the page's own policy


def test_drawn_coordinates_are_finite(html):
    drawn = re.findall(r" (?:d|transform|rx|ry|cx|cy)=['\"]([^'\"]*)['\"]", html)
    assert drawn
    assert not [text for text in drawn if re.search(r"nan|inf", text, re.I)]


def test_ignored_reading_is_listed_with_its_residual(html):
    found = re.search(r"Outliers, ignored: S2 to T021 \(\+(\d+\.\d) µm\)\.", words(html))
    # Three readings are left of that target and place it to some micrometres along the line of sight.
    assert float(found[1]) == pytest.approx(WRONG / UM, abs=30)


@pytest.mark.usefixtures("undrawn")
def test_ignored_reading_is_listed_without_raw_data(tmp_path):
    assert "Outliers, ignored: S2 to T021" in words(page(measured()[0], tmp_path))


@pytest.mark.usefixtures("undrawn")
def test_result_is_not_changed(tmp_path):
    errors, raw = measured()
    before = errors.copy(deep=True)
    network(errors)
    page(errors, tmp_path, raw=raw)
    xr.testing.assert_identical(errors, before)


def test_used_readings_are_counted_at_the_head_and_by_station():
    errors, raw = measured()
    used = np.isfinite(errors["residual"].values) & (errors["left_out"].values == 0)
    (part,) = chapters(Source(errors, raw))
    (count,) = [figure for figure in part.key_figures if figure.label == "readings"]
    assert (count.value.text, count.unit, count.note) == (str(used.sum()), "", "used; 1 ignored")
    (table,) = [
        block for section in part.sections for block in section.blocks if "dead paths" in getattr(block, "caption", "")
    ]
    column = list(table.head).index("used")
    assert [row[column].text for row in table.rows] == [str(number) for number in used.sum(axis=1)]


def test_missing_readings_are_counted_without_the_outlier(html):
    lost = int(np.isnan(measured()[1]["displacement"]).sum())
    assert f"{lost} of 192 readings are missing" in words(html)


def test_six_rigid_motions_are_reported_as_undetermined(html):
    text = words(html)
    assert "The six rigid motions of the volume, three translations and three rotations, are not determined" in text
    assert "rotations of the tool at a target, EA to EC, are unknown, not zero" in text


def test_longest_vector_is_that_of_the_data(html):
    net = network(measured()[0])
    worst = longest(net)
    size = float(net["length"][worst])
    assert size == pytest.approx(np.linalg.norm([net[name][worst] for name in ("EX", "EY", "EZ")]))
    assert f"third of the longest, {size / UM:.2f} µm at {net['target'].values[worst]}" in words(html)


def test_undetermined_error_motions_are_unknown_with_the_reason(html):
    assert html.count("not observed</text>") == sum(
        np.isnan(v.values).all() for name, v in measured()[0].data_vars.items() if re.fullmatch(r"E[XYZABC][XYZ]", name)
    )
    assert "EAZ: no effect on the reflector" in words(html)


def test_rotations_in_the_budget_are_dashes_and_never_zero(html):
    row = re.search(r"combined, k = 1</th>(.*?)</tr>", html, re.S)[1]
    assert len(re.findall("<td>—<sup>", row)) == 3


@pytest.mark.usefixtures("unprinted")
@pytest.mark.parametrize(
    "lost",
    [
        ["residual", "influence", "EYY_u", "EA0Z_u"],
        [
            "left_out",
            "redundancy",
            "dead_path",
            "dead_path_u",
            "station_nominal",
            "EXX",
            "EXX_u",
            "EC0Y",
            "axes_sigma0",
        ],
        ["station_place", "station_covariance"],
        ["target_nominal", "target_place", "noise", "sigma0", "freedom", "condition"],
    ],
)
def test_missing_variables_are_accepted(tmp_path, lost):
    html = page(measured()[0].drop_vars(lost), tmp_path, raw=measured()[1])
    assert [title for title in HEADINGS if f"<h2>{title}</h2>" not in html] == []
    assert "nan" not in words(html).lower().split()


@pytest.mark.usefixtures("unprinted")
def test_a_chapter_of_only_errors_states_what_is_missing(tmp_path):
    text = words(page(bare(), tmp_path))
    for sentence in ("No error vectors are drawn", "The result contains no stations", "contains no residuals"):
        assert sentence in text


@pytest.mark.usefixtures("undrawn")
@pytest.mark.usefixtures("unprinted")
def test_unknown_targets_are_counted(tmp_path):
    errors = measured()[0].copy(deep=True)
    for name in ("EX", "EY", "EZ", "covariance", "influence"):
        errors[name][{"target": [3, 4]}] = np.nan
    assert "The errors of 2 targets are unknown" in words(page(errors, tmp_path))


@pytest.mark.usefixtures("unprinted")
def test_result_without_known_targets_is_reported(tmp_path):
    errors = bare()
    for name in ("EX", "EY", "EZ", "covariance"):
        errors[name] = np.nan * errors[name]
    assert "the uncertainties of the targets are unknown" in words(page(errors, tmp_path))


@pytest.mark.usefixtures("undrawn")
def test_excluded_target_is_listed(tmp_path):
    errors = measured()[0].copy(deep=True)
    errors["left_out"][{"target": 5}] = 2
    assert "the wrong one is not determined: T006." in words(page(errors, tmp_path))


def test_names_with_markup_are_escaped(html):
    assert "<b>&'" not in html
    assert "&lt;b&gt;&amp;&#39;S1" in html


@pytest.mark.usefixtures("undrawn")
def test_plan_states_the_expected_uncertainty_and_no_errors(tmp_path):
    planned = bare(target_uncertainty=(("target",), np.full(12, UM)), sigma0=((), 0.0), freedom=((), 90))
    html = page(planned, tmp_path)
    assert "There are 90 more readings than unknowns." in html
    assert "The plan contains no better positions" in html
    assert "Expected uncertainty of a multilateration" in html
    assert "Errors of the volume" not in html
    assert "scatter of the readings" not in html  # nothing was measured


@pytest.mark.usefixtures("undrawn")
def test_plan_lists_best_and_set_positions(tmp_path):
    places = (("station", "direction"), 0.1 * np.arange(12.0).reshape(4, 3))
    best = (("station", "direction"), 0.1 * np.arange(12.0).reshape(4, 3) + 0.005)
    planned = bare(target_uncertainty=(("target",), np.full(12, UM)), station_place=places, best_place=best)
    assert "4 900 1000 1100 905 1005 1105" in words(page(planned, tmp_path))


def test_view_is_selected_by_the_buttons():
    """Each button shows one picture; all pictures have the same scale and are well-formed."""
    ends = np.array([[[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 2, 0]]], float)
    html = str(draw(Scene([Lines(ends, "#000000")]), "k"))
    pictures = re.findall(r"<svg id='(k-p\d+)'.*?</svg>", html)
    assert len(pictures) == 15
    assert html.count(" checked>") == 1
    assert all(f"#k-v{i}:checked~#k-p{i}" in html for i in range(15))
    for svg in re.findall(r"<svg.*?</svg>", html):
        ElementTree.fromstring(svg)


@pytest.mark.parametrize(("azimuth", "elevation"), [(0, 0), (0.4, 0.3), (2.0, np.pi / 2), (-1.2, 0.9)])
def test_camera_is_a_rotation_that_keeps_z_up(azimuth, elevation):
    R = camera(azimuth, elevation)
    assert pytest.approx(np.eye(3), abs=1e-14) == R @ R.T
    assert np.linalg.det(R) == pytest.approx(1)
    assert R[0, 2] == 0
    assert R[1, 2] >= -1e-15


def test_outline_of_an_ellipsoid_seen_from_above_is_its_section():
    shape = np.diag([4.0, 1.0, 100.0])[None]
    html = str(draw(Scene([Ellipsoids(np.zeros((1, 3)), shape, "#000000")]), "k"))
    above = re.search(r"id='k-p12'.*?<ellipse rx='([\d.]+)' ry='([\d.]+)'", html)
    assert float(above[1]) / float(above[2]) == pytest.approx(2, rel=0.01)  # two decimals of a point


def test_enlargement_is_a_round_number_and_never_reduces():
    assert enlargement(13.8e-6, 0.07) == 5000
    assert enlargement(1.0, 0.5) == 1
    assert enlargement(np.nan, 1.0) == 1


def test_thinned_targets_are_distinct_and_include_the_worst():
    kept = thinned(np.arange(1000), 50, always=777)
    assert 777 in kept
    assert len(set(kept.tolist())) == kept.size <= 51


def test_a_plan_draws_its_map_and_lists_the_targets_to_measure(tmp_path):
    place = np.stack(np.meshgrid([0.0, 0.1], [0.0, 0.2], [0.0, 0.1, 0.2], indexing="ij"), -1).reshape(-1, 3)
    sigma = UM * np.stack([np.linspace(1, 3, 12), np.linspace(0.5, 1, 12)])
    planned = bare(
        target_uncertainty=(("target",), np.full(12, UM)),
        map_position=(("place", "direction"), place),
        map_uncertainty=(("setup", "place"), sigma),
        chosen=(("place",), np.arange(12) % 4 == 0),
        gain=((), 3.0),
    )
    html = page(planned.assign(chosen=planned["chosen"].astype(np.int8)), tmp_path)
    text = words(html)
    assert "Predicted uncertainty" in html
    assert "<image" not in html  # the colour bar is drawn in lines
    assert "Gain (minimised uncertainty as set / best): 3.00" in text
    assert "as set 3.00 2.00 1.00" in text
    assert "best, Z = 100 mm" in text
    assert "3 100.0 0.0 200.0" in text  # the ninth of the positions
    (tmp_path / "other").mkdir()
    assert "Predicted uncertainty" not in page(bare(), tmp_path / "other")


@pytest.mark.usefixtures("undrawn")
def test_the_share_of_the_repeatability_is_stated(tmp_path):
    machine = VirtualMachine("cframe", seed=3)
    raw = simulation.raw(machine, simulation.target_grid(machine, (4, 4, 3)), seed=1, repeatability=2 * UM)
    errors = Multilateration().identify(raw, Multilateration.Settings(repeatability="2 um", parametric=False))
    html = page(errors, tmp_path)
    table = html[html.index("The solution.") :]
    cells = re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", table[: table.index("</table>")], flags=re.S)
    text = [unescape(re.sub(r"<[^>]+>", "", cell)).strip() for cell in cells]
    # 2 um beside the tracker's 0.5 um: 4 / 4.25
    share = text[text.index("share of the repeatability of the machine in the variance of a reading / %") + 1]
    assert float(share) == pytest.approx(100 * 4 / 4.25, abs=0.5)
