"""The chapter of a crossbeam campaign: complete, honest about holes, and readable with whatever a dataset lacks."""

import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest
import xarray as xr
from markupsafe import Markup
from matplotlib.figure import Figure
from matplotlib.text import Text

from errormotion.datasets import build_errors, provenance
from errormotion.datasets.results.effects import change_of
from errormotion.methods.crossbeam_scan import simulation
from errormotion.methods.crossbeam_scan.report.figures import figures
from errormotion.methods.crossbeam_scan.report.view import campaign
from errormotion.report import Form, canvas, write_report
from errormotion.report.fields import remarks
from errormotion.twin import VirtualMachine
from errormotion.twin.artefacts.pieces import swept

pytestmark = pytest.mark.usefixtures("translated")

MINUTES = (0, 7, 15, 30, 45, 60, 90, 120, 150, 180)
PLACES = 0.35 + 0.2 * np.arange(8) - 1.05
POSE = ("a", "b", "g", "dx", "dy", "dz")
#: extras that stand beside another one, and all others
BESIDE = (
    *("scan_time", "registration_u", "smooth_position_u", "smooth_time_u", "cold_repeat_u", "moved_since", "pose_u"),
    *("surface_x", "difference_before"),
)
EXTRAS = (
    *("reason", "scan_time", "registration_u", "predicted_u", "residual_rms", "points_used", "noise_found"),
    *("line_jitter", "condition", "surface", "surface_x", "surface_y", "difference_before", "difference_after"),
    *("smooth_position", "smooth_position_u", "smooth_time", "smooth_time_u", "cold_repeat", "cold_repeat_u"),
    *("moved", "moved_since", "profiler_pose", "pose_u", "lever", "strain"),
)


def campaign_dataset(minutes=MINUTES, places=PLACES, *, holes=(), moved=(), notes=()):
    """A campaign on the virtual gantry: what its crossbeam does, plus noise of the stated size, with every extra.

    ``holes`` are (cycle, artefact, reason, scanned): no value there; ``moved`` are indices of artefacts.
    """
    machine, rng = VirtualMachine("gantry", seed=3), np.random.default_rng(5)
    times, places = 60.0 * np.asarray(minutes, float), np.asarray(places, float)
    shape = (times.size, places.size)
    beam = machine.crossbeam
    by_registration = np.array([0.35e-6, 4e-9, 0.15e-6, 0.17e-6, 0.16e-6, 0.15e-6])
    values = beam.twist(times[:, None], places) + rng.normal(0, 1, (*shape, 6)) * by_registration
    influence = 1e-2 * values[None] * np.array([0.6, 0.8])[:, None, None, None]
    warm = (times > 0)[:, None, None]
    values, sigma = np.where(warm, values, 0.0), np.where(warm, by_registration, 0.0)
    influence = np.where(warm, influence, 0.0)
    reason, scan_time = np.full(shape, "", dtype="U90"), times[:, None] + 1.5 * np.arange(places.size)
    for cycle, artefact, why, scanned in holes:
        values[cycle, artefact], reason[cycle, artefact] = np.nan, why
        scan_time[cycle, artefact] = scan_time[cycle, artefact] if scanned else np.nan
    covariance = np.einsum("...i,ij->...ij", sigma**2, np.eye(6))
    covariance = covariance + np.einsum("s...i,s...j->...ij", influence, influence)
    known = np.isfinite(values[..., 0])
    x, y = np.linspace(-19.5e-3, 19.5e-3, 40), np.linspace(-27e-3, 27e-3, 40)
    surface = np.tile(swept().height(x[None], y[:, None]), (places.size, 1, 1)).astype(np.float32)
    slope_y, slope_x = np.gradient(surface[0], y, x)
    lever = beam.lever
    point = np.stack(np.broadcast_arrays(lever[0] + x[None], y[:, None], lever[2] - 0.17 + surface[0]), axis=-1)
    normal = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
    shift = values[..., None, None, :3] + np.cross(values[..., None, None, 3:], point)
    before = ((shift * normal).sum(axis=-1)).astype(np.float32)
    residual = np.where(known[..., None, None], rng.normal(0, 9e-8, before.shape), np.nan).astype(np.float32)
    fine_place, fine_time = np.linspace(places.min(), places.max(), 60), np.linspace(0, times.max(), 60)
    pair = ("time", "position")

    def array(data, dims, units=""):
        return xr.DataArray(data, dims=dims, attrs={"units": units} if units else {})

    def number(scale, spread=0.05):
        return array(np.where(known, scale * (1 + spread * rng.normal(0, 1, shape)), np.nan), pair)

    since = np.full(places.size, np.nan)
    since[list(moved)] = times[len(times) // 2]
    extras = {
        "reason": array(reason, pair),
        "scan_time": array(scan_time, pair, "s"),
        "registration_u": array(np.where(known[..., None], sigma, np.nan), (*pair, "dof")),
        "predicted_u": array(np.where(known[..., None], 0.9 * sigma, np.nan), (*pair, "dof")),
        "residual_rms": number(9e-8),
        "points_used": array(np.where(known, 2_381_000, 0), pair),
        "noise_found": number(5e-7),
        "line_jitter": array(np.where(known[..., None], [5e-7, 2e-6], np.nan), (*pair, "jitter"), "m"),
        "condition": number(30.0),
        "surface": array(surface, ("position", "v", "u"), "m"),
        "surface_x": array(x, ("u",), "m"),
        "surface_y": array(y, ("v",), "m"),
        "difference_before": array(before, (*pair, "v", "u"), "m"),
        "difference_after": array(residual, (*pair, "v", "u"), "m"),
        "smooth_position": array(beam.twist(times[:, None], fine_place), ("time", "place", "dof")),
        "smooth_position_u": array(np.full((times.size, 60, 6), 0.6) * by_registration, ("time", "place", "dof")),
        "smooth_time": array(beam.twist(fine_time[:, None], places), ("moment", "position", "dof")),
        "smooth_time_u": array(np.full((60, places.size, 6), 0.6) * by_registration, ("moment", "position", "dof")),
        "cold_repeat": array(rng.normal(0, 1, (1, places.size, 6)) * by_registration, ("repeat", "position", "dof")),
        "cold_repeat_u": array(np.tile(by_registration, (1, places.size, 1)), ("repeat", "position", "dof")),
        "moved": array(np.isin(np.arange(places.size), moved), ("position",)),
        "moved_since": array(since, ("position",), "s"),
        "profiler_pose": array(beam.pose, ("row", "column")),
        "pose_u": array([1e-4, 1e-5, 1e-4, 5e-6, 5e-6, 2e-6], ("pose_parameter",)),
        "lever": array(lever, ("direction",), "m"),
        "strain": array(np.where(known[..., None], [3e-6, 12e-6, 20e-6], np.nan), (*pair, "direction")),
    }
    instruments = [{"id": "profiler", "driver": "keyence_ljx", "address": "sim://gantry/profiler?seed=3"}]
    errors = build_errors(
        values,
        covariance,
        dims=pair,
        coords={
            "time": ("time", times, {"units": "s"}),
            "y": ("position", places, {"units": "m"}),
            "place": ("place", fine_place, {"units": "m"}),
            "moment": ("moment", fine_time, {"units": "s"}),
            "jitter": ("jitter", ["z", "y"]),
            "direction": ("direction", list("xyz")),
            "pose_parameter": ("pose_parameter", list(POSE)),
        },
        component="Y",
        machine="Gantry 4000",
        frame="carriage",
        functional_point=[0, 0, 0],
        reference="cold state at time 0",
        method="crossbeam_scan",
        method_version="1",
        provenance=provenance.make({"procedure": "scan", "scan_length": 0.056}, None, instruments),
        influence=influence,
        sources=["profiler pose 1", "cold scan 1"],
        source_groups=["profiler pose", "cold scan"],
        extras=extras,
    )
    return errors.assign_attrs(notes=json.dumps(list(notes)))


HOLES = (
    (4, 2, "no scan: the stream ended before the artefact", False),
    (7, 6, "refused: 34 % of the points are missing", True),
)


def pose_dataset():
    """The profiler's pose as the calibration hands it over."""
    pose = VirtualMachine("gantry", seed=3).crossbeam.pose
    sigma = np.array([1e-5, 2e-6, 1e-5, 4e-7, 4e-7, 2e-7])
    correlation = np.eye(6)
    correlation[0, 4] = correlation[4, 0] = 0.6
    covariance = sigma[:, None] * correlation * sigma
    extras = {
        "profiler_pose": xr.DataArray(pose, dims=("row", "column")),
        "pose_covariance": xr.DataArray(covariance, dims=("p", "p_")),
        "edge_scatter": xr.DataArray([2e-6, 3e-6], dims="edge_direction", attrs={"units": "m"}),
    }
    return build_errors(
        np.array([[2.787e-3, 2.94e-3, 0.0, 1.08e-3, 2.6e-3, -7.2e-3]]),
        covariance[None],
        dims=("beam",),
        coords={"beam": ["profiler"]},
        component="beam",
        machine="Gantry 4000",
        frame="tool",
        functional_point=[0, 0, -0.173],
        reference="nominal pose of the profiler",
        method="crossbeam_scan",
        method_version="1",
        provenance=provenance.make({"procedure": "profiler_pose"}, None, None),
        extras=extras,
    )


def words_of(html):
    """The text of a page, without drawings and their words."""
    text = re.sub(r"<svg.*?</svg>|<style.*?</style>|<[^>]+>", " ", html, flags=re.DOTALL)
    return " ".join(text.replace("&#39;", "'").split())


def drawings(html):
    return [ElementTree.fromstring(svg) for svg in re.findall(r"<svg.*?</svg>", html, flags=re.DOTALL)]


@pytest.fixture
def page(tmp_path):
    def write(errors):
        return write_report(errors, tmp_path / "report.html").read_text(encoding="utf-8")

    return write


@pytest.fixture
def undrawn(page, monkeypatch):
    """Pages without their drawings: for what stands in words and tables."""
    monkeypatch.setattr(canvas, "draw", lambda *_, **__: Markup("<svg></svg>"))
    return page


@pytest.fixture
def painted(page, monkeypatch):
    """Pages whose figures are filled, but not written as SVG: for what a dataset may lack."""

    def draw(paint, _, height, width=canvas.WIDTH):
        with canvas.style():
            figure = Figure(figsize=(width, height))
            paint(figure)
        return Markup("<svg>{}</svg>").format(" ".join(each.get_text() for each in figure.findobj(Text)))

    monkeypatch.setattr(canvas, "draw", draw)
    return page


@pytest.fixture(scope="module")
def whole():
    return campaign_dataset(holes=HOLES, moved=[5], notes=["The head of the profiler warmed by 1.2 K."])


@pytest.fixture(scope="module")
def small():
    """Two warm cycles of three artefacts, one scan missing."""
    return campaign_dataset(minutes=(0, 30, 60), places=PLACES[:3], holes=[(1, 1, "no scan", False)])


@pytest.fixture(scope="module")
def html(whole, tmp_path_factory):
    path = tmp_path_factory.mktemp("crossbeam") / "report.html"
    return write_report(whole, path).read_text(encoding="utf-8")


def table(html, caption):
    """Rows of the table with this caption, each the texts of its cells."""
    found = next(t for t in re.findall(r"<table.*?</table>", html, flags=re.DOTALL) if caption in t)
    rows = re.findall(r"<tr.*?</tr>", found.partition("<tbody>")[2], flags=re.DOTALL)
    return [[words_of(cell) for cell in re.findall(r"<t[hd].*?</t[hd]>", row, flags=re.DOTALL)] for row in rows]


def test_the_chapter_has_its_sections(html):
    for name in ("summary", "errors", "registration", "setup", "stability", "uncertainty", "quality", "provenance"):
        assert f'id="{name}-1"' in html


def test_file_is_small_and_has_no_external_links(html):
    assert len(html.encode()) < 3_000_000
    assert not re.findall(r"https?:", html)
    assert html.count("<script") == 1  # that of the page
    assert "<image" not in html
    assert re.findall(r"url\((?!#)", html) == []


def test_every_figure_is_drawn_with_a_text_alternative(html):
    assert len(drawings(html)) == 5
    message = re.findall(r'<figure role="img" aria-label="([^"]+)"', html)
    assert len(message) == 5
    assert all(len(words) > 60 for words in message)


def test_key_figures_are_the_largest_warm_errors_with_position_and_time(html, whole):
    values = whole["EY"].values * 1e6
    expanded = 1e6 * campaign(whole).extreme(1).expanded
    cycle, artefact = np.unravel_index(np.nanargmax(np.abs(values)), values.shape)
    largest = re.search(r"largest EYY (\S+) µm ± (\S+) µm \(k = 2\) y = (\S+) mm, (\d+) min", words_of(html))
    # Printed to the second digit of the uncertainty: half a step of 0.01 um.
    assert float(largest[1]) == pytest.approx(values[cycle, artefact], abs=5.1e-3)
    assert float(largest[2]) == pytest.approx(expanded, abs=5.1e-3)
    assert float(largest[3].replace("−", "-")) == pytest.approx(1e3 * PLACES[artefact])
    assert int(largest[4]) == MINUTES[cycle]


def test_registrations_are_counted_and_missing_ones_by_reason(html):
    text = words_of(html)
    assert "registrations made 70 of 72 1 without a scan, 1 refused" in text
    for _, _, reason, _ in HOLES:
        assert f"mm, 45 min: {reason}." in text or f"mm, 120 min: {reason}." in text


def test_missing_value_is_a_dash_with_its_reason_as_a_footnote(html):
    rows = table(html, "Quality of every registration")
    holes = [row for row in rows if len(row) > 1 and row[1].startswith("—")]
    assert [row[0] for row in holes] == ["y = −300 mm", "y = 500 mm"]
    marks = [row[1].split()[1] for row in holes]
    assert marks == ["a", "b"]
    for mark, (_, _, reason, _) in zip(marks, HOLES, strict=True):
        assert f"{mark} {reason}." in words_of(html)


def test_every_registration_has_its_row_under_its_cycle(html, whole):
    rows = table(html, "Quality of every registration")
    heads = [row[0] for row in rows if len(row) == 1]
    assert heads == [f"{minutes} min of warm-up" for minutes in MINUTES[1:]]
    assert len(rows) == 9 + 72
    first = rows[1]
    assert first[0] == "y = −700 mm"
    # Worst of three, at the carriage: 350 nm and 0.17 urad, by 0.9 in prediction.
    assert first[1:5] == ["315", "0.153", "350", "0.170"]
    assert float(first[5]) == pytest.approx(float(whole["residual_rms"][1, 0]) * 1e6, abs=6e-4)
    assert first[6] == "2 381 000"
    assert first[8:] == ["0.50", "2.00"]


def test_a_long_campaign_has_a_row_for_each_cycle(undrawn):
    errors = campaign_dataset(minutes=[0, *range(5, 205, 5)], holes=[(3, 1, "the scan is broken", True)])
    rows = table(undrawn(errors), "the worst of each cycle")
    assert len(rows) == 40
    assert rows[2][0] == "15 min: 7 of 8"
    # The worst of the cycle: the largest residual, the fewest points.
    worst = np.nanmax(errors["residual_rms"].values[3]) * 1e6
    assert float(rows[2][5]) == pytest.approx(worst, abs=6e-4)


def test_text_on_the_residual_states_the_effect_of_a_wrong_pose(html, whole):
    found = re.search(
        r"rotation (\w+) of the registration is (\S+) µrad, and an error of the pose of 10 times this value would "
        r"change the residual from (\S+) nm to (\S+) nm",
        words_of(html),
    )
    assert found[1] == "ECY"
    assert float(found[2]) == pytest.approx(0.15)
    # Turned by 1 mrad about z, scaled down: a rotation of 1.5 urad, ten times 0.15.
    x, y = np.meshgrid(whole["surface_x"].values, whole["surface_y"].values)
    c, s = np.cos(1e-3), np.sin(1e-3)
    change = swept().height(c * x - s * y, s * x + c * y) - swept().height(x, y)
    added = 1.5e-3 * np.sqrt(np.mean(change**2))
    before, after = float(found[3]) * 1e-9, float(found[4]) * 1e-9
    # Gradients of the thinned map (1 mm) are some percent off; the printed digits carry 0.005 nm.
    assert after == pytest.approx(np.hypot(before, added), abs=0.1 * (after - before) + 1e-11)


def test_the_maps_show_the_last_cycle_of_the_artefact_with_the_largest_error(html, whole):
    assert "One registration: the artefact at y = 700 mm, 180 min" in words_of(html)
    assert campaign(whole).shown() == (9, 7)


def test_an_artefact_that_moved_is_a_warning(html):
    found = re.findall(r'<p class="warning">(The artefact .*?)</p>', html)
    assert [words_of(text).partition(".")[0] for text in found] == [
        "The artefact at y = 300 mm moved on the table since the scan at 60 min"
    ]


def test_remarks_of_the_method_are_warnings(html):
    assert '<p class="warning">The head of the profiler warmed by 1.2 K.</p>' in html


@pytest.mark.parametrize(
    ("notes", "message"),
    [(["One.", "", "Two."], ["One.", "Two."]), ('["One."]', ["One."]), ("One.", ["One."]), ("", []), ([""], [])],
)
def test_remarks_may_be_a_list_or_its_json(notes, message):
    assert remarks(xr.Dataset(attrs={"notes": notes})) == message


def test_cold_repeat_is_assessed_by_its_uncertainty(undrawn, small):
    errors = small.copy(deep=True)
    errors["cold_repeat"][0, 2, 1] = 5 * 2 * errors["cold_repeat_u"][0, 2, 1]
    found = re.search(r'<p class="warning">(Cold repeat: .*?)</p>', undrawn(errors))
    assert "the largest is EYY at y = −300 mm with 5 times its uncertainty" in words_of(found[1])


def test_the_pose_is_reported_in_angles_and_shifts(html):
    rows = {row[0]: row[1:] for row in table(html, "Pose of the profiler in the tool frame")}
    # H[0, 2] = sin b; 2 sigma of b are 0.02 mrad.
    pose = VirtualMachine("gantry", seed=3).crossbeam.pose
    value, _, expanded = rows["b, rotation about y"][1].partition(" ± ")
    assert float(value) == pytest.approx(1e3 * np.arcsin(pose[0, 2]), abs=6e-4)
    assert float(expanded) == pytest.approx(0.02)
    assert rows["lever in x"] == ["mm", "−900.000"]


def test_budget_is_at_the_position_of_the_map(html):
    assert "Uncertainty budget at y = 700 mm, 180 min of warm-up" in words_of(html)
    names = [row[0] for row in table(html, "Uncertainty budget")]
    assert names[:3] == ["profiler pose", "cold scan", "noise of the warm scan, independent from scan to scan"]


def test_a_cold_state_that_is_known_exactly_is_no_largest_error(painted):
    everywhere = [(cycle, artefact, "no scan", False) for cycle in range(1, 3) for artefact in range(8)]
    html = painted(campaign_dataset(minutes=(0, 30, 60), holes=everywhere))
    text = words_of(html)
    assert "there is no thermal error to report" in text
    assert "largest EXY" not in text
    assert "registrations made 0 of 16" in text


@pytest.mark.parametrize(
    ("minutes", "places", "figures"),
    [
        ((0, 60), PLACES, 3),  # along the axis, the maps, the set-up
        (MINUTES, PLACES[:1], 3),  # over time, the maps, the set-up
        ((0, 60), PLACES[:1], 2),
        ((0,), PLACES, 1),  # nothing warm
    ],
)
def test_one_cycle_or_one_artefact_is_a_report_without_empty_figures(painted, minutes, places, figures):
    html = painted(campaign_dataset(minutes=minutes, places=places))
    assert len(drawings(html)) == figures
    assert "not determined" not in html


@pytest.mark.parametrize("kept", [(), BESIDE, set(EXTRAS) - set(BESIDE)])
def test_report_without_any_of_the_extras_has_the_rest(painted, small, kept):
    html = painted(small.drop_vars([name for name in EXTRAS if name not in kept]))
    assert "registrations made 5 of 6" in words_of(html)
    assert "The six errors in the last cycle" in html
    assert "nan" not in words_of(html).lower().split()


def test_extras_of_nan_only_are_not_shown_as_values(page, small):
    errors = small.copy()
    for name in EXTRAS:
        if errors[name].dtype.kind == "f":
            errors[name] = errors[name] * np.nan
    html = page(errors)
    assert "registrations made 5 of 6" in words_of(html)
    assert "nan" not in words_of(html).lower().split()


@pytest.fixture(scope="module")
def of_constants(small, tmp_path_factory):
    """Return the page of errors of which two are the same everywhere, and one is never observed."""
    constant = {"EX": 0 * small["EX"], "EA": 0 * small["EA"] + 1e-6, "EB": small["EB"] * np.nan}
    errors = small.drop_vars("surface").assign(constant).copy(deep=True)
    k = list(errors["dof"].values).index("EB")
    errors["covariance"].values[..., k, :] = errors["covariance"].values[..., :, k] = np.nan
    errors["influence"].values[..., k] = np.nan
    return write_report(errors, tmp_path_factory.mktemp("crossbeam") / "report.html").read_text(encoding="utf-8")


def test_freedom_that_is_never_observed_is_reported(of_constants):
    assert "Not observed by this test: EBY." in words_of(of_constants)
    assert of_constants.count(">not observed<") == 3


def test_an_error_that_is_the_same_everywhere_is_drawn_without_a_warning(of_constants):
    assert "largest EXY 0.0" in words_of(of_constants)


def test_artefacts_are_in_the_order_of_their_positions(undrawn):
    html = undrawn(campaign_dataset(minutes=(0, 30, 60), places=[0.3, -0.1, 0.1]))
    assert [row[0] for row in table(html, "The six errors in the last cycle")] == ["−100 mm", "100 mm", "300 mm"]


def test_positions_and_times_have_no_trailing_zeros_in_german(small, tmp_path):
    html = write_report(small, tmp_path / "report.html", form=Form(language="de")).read_text(encoding="utf-8")
    rows = [row[0] for row in table(html, "Qualität jeder Registrierung")]
    assert rows == ["30 min Warmlauf", "y = −700 mm", "y = −500 mm", "y = −300 mm", "60 min Warmlauf", *rows[5:]]


def test_truth_of_the_machine_has_the_generic_chapter(undrawn):
    truth = simulation.truth_axis(VirtualMachine("gantry", seed=3), [0.0, 600.0], PLACES)
    assert "Errors of component Y" in undrawn(truth)


def test_pose_of_the_profiler_has_a_separate_chapter(page):
    html = page(pose_dataset())
    text = words_of(html)
    assert "Pose of the line profiler" in text
    assert "scatter of the edge 2.00 µm, 3.00 µm" in text
    assert "Detection of the laser beams" not in text
    correlation = {row[0]: row[1:] for row in table(html, "Correlation of the parameters")}
    assert correlation["a"][4] == "0.60"


def test_map_is_one_path_for_each_colour_with_its_gaps():
    from errormotion.report.drawings.maps import DIVERGING, cells, scale_of

    rng = np.random.default_rng(0)
    values = rng.normal(0, 1, (40, 40))
    values[10:12, 5:9] = np.nan
    axes = Figure().subplots()
    scale = scale_of(values, 10, DIVERGING)
    cells(axes, np.arange(40.0), np.arange(40.0), values, scale)
    assert len(axes.patches) <= scale.cmap.N
    area = 0.0
    for patch in axes.patches:
        for corners in patch.get_path().vertices.reshape(-1, 5, 2):
            area += np.ptp(corners[:, 0]) * np.ptp(corners[:, 1])
    assert area == pytest.approx(40 * 40 - 8)


def test_zero_is_white_and_both_sides_have_the_same_depth():
    from errormotion.report.drawings.maps import scale_of

    scale = scale_of(np.array([-1.0, 4.0]), 10)
    low, high = np.array(scale.to_rgba([-0.01, 0.01]))[:, :3]
    assert (low > 0.85).all()
    assert (high > 0.85).all()
    # One unit below zero is as far from white as one unit above it, not as four units are.
    below, above, far = 1 - np.array(scale.to_rgba([-0.9, 0.9, 3.9]))[:, :3].min(axis=1)
    assert below == pytest.approx(above, abs=0.15)
    assert far > 2 * below


def test_figures_are_the_largest_errors_with_their_expanded_uncertainty():
    errors = campaign_dataset(holes=HOLES)
    found = {one.name.split()[1]: one for one in figures(errors)}
    assert list(found) == ["EXY", "EYY", "EZY", "EAY", "EBY", "ECY"]
    k, j = np.unravel_index(np.nanargmax(np.abs(errors["EY"].values)), errors["EY"].shape)
    assert found["EYY"].value == errors["EY"].values[k, j]
    # The largest of several noisy values is too large; the bias is part of its uncertainty.
    assert 1.0 <= found["EYY"].expanded_uncertainty / (2 * np.sqrt(errors["covariance"].values[k, j, 1, 1])) < 2.5
    assert found["EYY"].name == f"largest EYY at y = {1e3 * PLACES[j]:g} mm, {MINUTES[k]} min"
    assert [one.unit for one in found.values()] == ["m"] * 3 + ["rad"] * 3


def test_figures_of_a_pose_are_its_errors_and_a_plan_has_none():
    errors = pose_dataset()
    found = figures(errors)
    assert [one.value for one in found] == [float(errors[name][0]) for name in ("EX", "EY", "EZ", "EA", "EB", "EC")]
    assert [one.expanded_uncertainty for one in found] == list(2 * np.sqrt(np.diag(errors["covariance"].values[0])))
    assert figures(errors.assign_attrs(reference="planned measurement")) == []


def test_sources_of_a_figure_are_those_of_the_error_that_it_is(whole):
    # many sources: the changes of a figure by each of them are not computed
    for figure in figures(whole):
        stated = [figure.influence[name] for name in whole["source"].values]
        changes = [change_of(whole, row, figure.name) for row in range(whole.sizes["source"])]
        assert stated == pytest.approx(changes, rel=1e-9, abs=1e-15)
