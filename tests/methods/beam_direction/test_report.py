"""Chapter of a beam's direction: sections, unknown quantities, and missing variables."""

import re
from functools import cache
from xml.etree import ElementTree

import numpy as np
import pytest
import xarray as xr

from errormotion.datasets import DOF, build_errors, provenance
from errormotion.datasets.calibrations.inclination import InclinationCalibration
from errormotion.methods.beam_direction import simulation
from errormotion.methods.beam_direction.identification.inclination.calibrate import calibrate
from errormotion.methods.beam_direction.method import BeamDirection
from errormotion.methods.beam_direction.report import surface
from errormotion.methods.beam_direction.settings import BeamDirectionSettings
from errormotion.report import write_report
from errormotion.twin import VirtualMachine

pytestmark = pytest.mark.usefixtures("translated")

ARCSEC = np.pi / 180 / 3600
DEGREE = np.pi / 180
PLANES = ((20, 0), (20, 90), (25, 180), (30, 270))
NOISE = 0.4e-6


@pytest.fixture(scope="module", autouse=True)
def coarse_maps():
    """Draw the maps of the calibration, which is read once, with fewer cells."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(surface, "_STEPS", 21)
        patch.setattr(InclinationCalibration, "load", cache(InclinationCalibration.load))
        yield


@cache
def calibration():
    """Return a calibration without settings between the rotations 10 and 90 degrees, and with one wrong setting."""
    raw = simulation.raw_inclination(
        VirtualMachine("cframe", seed=3),
        DEGREE * np.arange(-45, 46, 7.5),
        DEGREE * np.array([0, 5, 10, 90, 170, 175]),
        1e-3 * np.arange(-10, 11, 4),
        seed=1,
    )
    wrong = np.isclose(raw["inclination"], 15 * DEGREE) & np.isclose(raw["rotation"], 5 * DEGREE)
    return calibrate(raw.assign(reading=raw["reading"].where(~wrong, 1.004 * raw["reading"])))


def k_of(q):
    return calibration().slope(q)[0]


def axes_of(u, t):
    e1 = np.cross(t, u)
    e1 /= np.linalg.norm(e1)
    return e1, np.cross(u, e1)


def rotation_to(nominal, actual):
    """Return the smallest rotation vector from one unit vector to another."""
    across = np.cross(nominal, actual)
    size = np.linalg.norm(across)
    return across / size * np.arctan2(size, nominal @ actual)


def solved(gradients, start):
    """Return the unit vector with gradients.u = -1 in the least-squares sense."""
    u = start
    for _ in range(20):
        a, b = axes_of(u, np.array([0.0, 1.0, 0.0]))
        J = np.stack([gradients @ a, gradients @ b], axis=1)
        step = np.linalg.lstsq(J, -1 - gradients @ u, rcond=None)[0]
        u = u + step @ np.stack([a, b])
        u /= np.linalg.norm(u)
    return u, np.linalg.inv(J.T @ J), np.stack([a, b])


def result(planes=PLANES, *, compensated=True, origin=True, bar=True, left_out=((1, 14),), compensation="lk-h050"):
    """Return a beam at 20 degrees, determined from planes of a sine gauge, each scanned along X, Y and Z."""
    rng = np.random.default_rng(1)
    nominal = np.array([np.sin(20 * DEGREE), 0.0, -np.cos(20 * DEGREE)])
    triangulation = np.array([0.0, 1.0, 0.0])
    e1, e2 = axes_of(nominal, triangulation)
    actual = nominal + 3.1e-3 * e1 - 1.7e-3 * e2
    actual /= np.linalg.norm(actual)
    e1, e2 = axes_of(actual, triangulation)
    alpha, beta = np.array(planes, float).T * DEGREE
    q = np.tan(alpha)[:, None] * np.stack([np.cos(beta), np.sin(beta)], axis=1)
    normals = -actual + q[:, :1] * e1 + q[:, 1:] * e2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    line = np.linspace(-3e-3, 3e-3, 21)
    stage = np.concatenate([np.outer(line, axis) for axis in np.eye(3)])
    A = np.column_stack([stage, np.ones(len(stage))])
    shape = (len(planes), len(stage))
    depth = -(stage @ normals.T).T / (normals @ actual)[:, None] + 1e-3
    raw = depth * (1 + k_of(q)[:, None]) + rng.normal(0, NOISE, shape)
    out = np.zeros(shape, dtype=np.int8)
    for plane, reading in left_out:
        raw[plane, reading] += 25e-6
        out[plane, reading] = 1
    clean = raw / (1 + k_of(q)[:, None])

    def gradients(readings):
        fits = [np.linalg.lstsq(A[use], r[use], rcond=None)[0] for r, use in zip(readings, out == 0, strict=True)]
        return np.array(fits)

    fit = gradients(clean if compensated else raw)
    g = fit[:, :3]
    u, spread, (a, b) = solved(g, nominal)
    before = solved(gradients(raw)[:, :3], nominal)[0]
    G = NOISE**2 * np.linalg.inv(A.T @ A)[:3, :3]
    gradient_u = np.sqrt(u @ G @ u)
    across = gradient_u**2 * spread
    C = np.zeros((6, 6))
    C[3:, 3:] = np.stack([a, b]).T @ across @ np.stack([a, b])
    C[:3, :3] = np.eye(3) * 4e-6**2 if origin else np.nan
    shift = np.array([120e-6, -80e-6, 45e-6]) if origin else np.full(3, np.nan)
    twist = np.concatenate([shift, rotation_to(nominal, u)])
    covariance = np.full((6, 6), np.nan)
    covariance[:3, :3] = C[:3, :3]
    turn = np.array([np.cross(nominal, axis) for axis in (a, b)])
    covariance[3:, 3:] = turn.T @ across @ turn
    covariance[:3, 3:] = covariance[3:, :3] = 0 if origin else np.nan
    place = np.array([0.02, 0.01, 0.15])
    vector, by_reading = ("beam", "direction"), ("plane", "reading")

    def array(data, dims, units=""):
        return xr.DataArray(np.asarray(data), dims=dims, attrs={"units": units} if units else {})

    used = clean if compensated else raw
    extras = {
        "beam_origin": array([place + shift], vector, "m"),
        "beam_direction": array([u], vector, "1"),
        "nominal_origin": array([place], vector, "m"),
        "nominal_direction": array([nominal], vector, "1"),
        "beam_covariance": array([C], ("beam", "p", "p_")),
        "gradient": array(g, ("plane", "direction"), "1"),
        "gradient_covariance": array(np.tile(G, (len(planes), 1, 1)), ("plane", "direction", "direction_"), "1"),
        "normal": array(normals, ("plane", "direction"), "1"),
        "inclination": array(alpha, "plane", "rad"),
        "rotation": array(beta, "plane", "rad"),
        "closure": array(g @ u + 1, "plane", "1"),
        "closure_uncertainty": array(np.full(len(planes), gradient_u), "plane", "1"),
        "residual": array(used - fit @ A.T, by_reading, "m"),
        "left_out": array(out, by_reading),
        "distance_raw": array(raw, by_reading, "m"),
        "distance_compensated": array(used, by_reading, "m"),
        "compensation": array(raw - clean if compensated else np.full(shape, np.nan), by_reading, "m"),
        "stage": array(np.tile(stage, (len(planes), 1, 1)), ("plane", "reading", "direction"), "m"),
        "uncompensated_direction": array([before], vector, "1"),
        "iterations": array([4], "beam"),
        "noise": array([NOISE], "beam", "m"),
    }
    if bar:
        angle = np.linspace(-50, 50, 20) * DEGREE
        off = rng.normal(0, 1.5e-6, 20)
        off[8] = -60e-6
        centre = np.array([-19.05e-3, 0.0, 61.24e-3])
        points = centre + (25e-3 + off)[:, None] * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)
        extras |= {
            "bar_point": array(points, ("bar_reading", "direction"), "m"),
            "bar_residual": array(off, "bar_reading", "m"),
            "bar_left_out": array(np.arange(20) == 8, "bar_reading"),
            "bar_centre": array(centre, "direction", "m"),
            "bar_radius_fitted": array(25.0009e-3, (), "m"),
        }
    instruments = [{"id": "sensor", "driver": "keyence_lk", "address": "tcp://192.0.2.7:1024"}]
    return build_errors(
        twist[None],
        covariance[None],
        dims=("beam",),
        coords={"beam": ["sensor"], "direction": ("direction", list("xyz"))},
        component="beam",
        machine="C-frame 610",
        frame="machine",
        functional_point=place,
        reference="nominal beam",
        method="beam_direction",
        method_version="1",
        provenance=provenance.make({"compensation": compensation if compensated else None}, None, instruments),
        extras=extras,
    )


def words_of(html):
    """Return the text of a page without its drawings and their labels."""
    text = re.sub(r"<svg.*?</svg>|<style.*?</style>|<[^>]+>", " ", html, flags=re.DOTALL)
    return " ".join(text.replace("&#39;", "'").split())


def drawings(html):
    return [ElementTree.fromstring(svg) for svg in re.findall(r"<svg.*?</svg>", html, flags=re.DOTALL)]


def table(html, caption):
    """Return the rows of the table with this caption, each as the texts of its cells."""
    found = next(t for t in re.findall(r"<table.*?</table>", html, flags=re.DOTALL) if caption in t)
    rows = re.findall(r"<tr.*?</tr>", found.partition("<tbody>")[2], flags=re.DOTALL)
    return [[words_of(cell) for cell in re.findall(r"<t[hd].*?</t[hd]>", row, flags=re.DOTALL)] for row in rows]


def number(text):
    """Return the value at the start of a cell."""
    return float(text.split()[0].replace("−", "-"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder in which the calibration is found by its name."""
    found = tmp_path_factory.mktemp("lab")
    (found / "calibrations").mkdir()
    calibration().save(found / "calibrations" / "lk-h050.nc")
    return found


@pytest.fixture
def page(folder, tmp_path, monkeypatch):
    """Write the report in the folder with the calibration."""
    monkeypatch.chdir(folder)

    def write(errors, **more):
        return write_report(errors, tmp_path / "report.html", **more).read_text(encoding="utf-8")

    return write


@pytest.fixture(scope="module")
def html(folder):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        errors = result(compensation="calibrations/lk-h050.nc")
        return write_report(errors, folder / "report.html").read_text(encoding="utf-8")


def test_the_chapter_has_its_sections(html):
    for name in ("summary", "direction", "planes", "compensation", "surface", "bar", "uncertainty", "quality"):
        assert f'id="{name}-1"' in html


def test_every_figure_is_drawn_and_has_a_text_alternative(html):
    assert len(drawings(html)) == 6
    reported = re.findall(r'<figure role="img" aria-label="([^"]+)"', html)
    assert len(reported) == 6
    assert all(len(words) > 60 for words in reported)


def test_the_file_is_small_and_has_no_external_links(html):
    assert len(html.encode()) < 1_500_000
    assert not re.findall(r"https?:", html)
    assert html.count("<script") == 1  # that of the page
    assert "<image" not in html
    assert re.findall(r"url\((?!#)", html) == []


def test_angles_are_stated_in_three_units_with_their_uncertainty(html):
    errors = result()
    rows = {row[0]: row[1:] for row in table(html, "Angles from the nominal")}
    u, nominal = errors["beam_direction"].values[0], errors["nominal_direction"].values[0]
    angle = np.arccos(u @ nominal)
    # Printed to the second digit of an uncertainty of some 30 arcsec, so to 1 arcsec.
    assert number(rows["to nominal"][0]) == pytest.approx(angle / ARCSEC, abs=0.51)
    assert number(rows["to nominal"][1]) == pytest.approx(1e3 * angle, abs=5.1e-3)
    assert number(rows["to nominal"][2]) == pytest.approx(angle / DEGREE, abs=5.1e-5)
    for i, name in enumerate("XYZ"):
        freedom = f"E{'ABC'[i]}"
        row = rows[f"{freedom}, about {name}"]
        expanded = 2 * np.sqrt(errors["covariance"].values[0, 3 + i, 3 + i])
        assert number(row[0]) == pytest.approx(errors[freedom].values[0] / ARCSEC, abs=0.51)
        assert number(row[0].partition("± ")[2]) == pytest.approx(expanded / ARCSEC, rel=0.06)


def test_the_zero_point_is_stated_in_mm_with_the_nominal_one(html):
    rows = {row[0]: row[1:] for row in table(html, "Zero point")}
    assert rows["x"] == ["+20.1200 ± 0.0080", "+20.000", "+120.0 ± 8.0"]


def test_every_plane_has_its_tilt_residual_and_closure(html):
    errors = result()
    rows = table(html, "The planes.")
    assert [(float(row[1]), float(row[2])) for row in rows] == [(float(a), float(b)) for a, b in PLANES]
    assert [row[3:5] for row in rows] == [["63", "0"], ["62", "1"], ["63", "0"], ["63", "0"]]
    for k, row in enumerate(rows):
        used = errors["left_out"].values[k] == 0
        rms = np.sqrt(np.mean(errors["residual"].values[k][used] ** 2))
        assert float(row[5]) == pytest.approx(1e6 * rms, abs=5.1e-3)
        assert number(row[7]) == pytest.approx(1e6 * errors["closure"].values[k], abs=0.51)


def test_an_ignored_reading_is_listed_with_its_position(html):
    (row,) = table(html, "Readings that were left out")
    # Reading 15 of the stroke along X: from -3 mm in steps of 0.3 mm.
    assert row[:3] == ["plane 2, reading 15", "X", "X 1.200; Y 0.000; Z 0.000"]
    assert number(row[4]) == pytest.approx(25, abs=1.5)  # the noise, and what the fit makes of it


def test_the_direction_is_stated_before_and_after_compensation(html):
    errors = result()
    rows = {row[0]: row[1:] for row in table(html, "Direction before and after")}
    u, before = errors["beam_direction"].values[0], errors["uncompensated_direction"].values[0]
    assert [number(cell) for cell in rows["compensated"][:3]] == pytest.approx(u, abs=5.1e-7)
    assert [number(cell) for cell in rows["without compensation"][:3]] == pytest.approx(before, abs=5.1e-7)
    turned = np.linalg.norm(np.cross(u, before))
    assert number(rows["without compensation"][4]) == pytest.approx(turned / ARCSEC, abs=0.051)
    taken = table(html, "Corrections of the raw readings")
    for k, row in enumerate(taken):
        spans = 1e6 * errors["compensation"].values[k]
        assert [number(cell) for cell in row[3:5]] == pytest.approx([spans.min(), spans.max()], abs=5.1e-3)


@pytest.mark.usefixtures("undrawn")
def test_a_tilt_that_the_calibration_does_not_cover_is_reported(page):
    supported, bare = (
        page(result(planes)) for planes in (((20, 0), (20, 90), (25, 180)), ((20, 0), (30, 45), (25, 180)))
    )
    reported = [re.search(r'aria-label="(Maps of the inclination error[^"]+)"', html)[1] for html in (supported, bare)]
    assert "not covered" not in reported[0]
    assert re.search(r"plane 2 \S+ \(not covered\)", reported[1])
    assert "extrapolated" not in supported
    assert "The tilt of plane 2 to the beam is outside the settings of the calibration" in words_of(bare)


def test_the_calibration_is_reported_with_its_remaining_error(html):
    found = re.search(r"at 78 tilts, 1 of them left out, fitted by a polynomial of order (\d+)", words_of(html))
    assert int(found[1]) == calibration().order
    reported = re.search(r"were left out of the fit: (\S+) µm per mm \(95 %: (\S+) to (\S+)\)", words_of(html))
    ds = calibration().dataset
    expected = 1e3 * np.array([ds["remaining_error"].item(), *ds["remaining_error_interval"].values])
    np.testing.assert_allclose([float(number) for number in reported.groups()], expected, rtol=0.06)  # two digits


@pytest.mark.usefixtures("undrawn")
def test_a_missing_calibration_is_stated(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    html = write_report(result(), tmp_path / "report.html").read_text(encoding="utf-8")
    assert "No map: the calibration 'lk-h050' cannot be shown" in words_of(html)
    assert len(drawings(html)) == 5


@pytest.mark.usefixtures("undrawn")
def test_a_calibration_of_the_same_name_and_another_content_is_not_shown(page):
    errors = result()
    errors["compensation"] = 1.1 * errors["compensation"]
    html = page(errors)
    assert "No map: the content of the calibration 'lk-h050' is not that used for the correction" in words_of(html)


@pytest.mark.usefixtures("undrawn")
def test_the_calibration_beside_the_campaign_is_found_from_elsewhere(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = {"campaign": {"folder": str(folder)}}
    html = write_report(result(), tmp_path / "report.html", run=run).read_text(encoding="utf-8")
    assert "Calibration 'lk-h050': slope k" in words_of(html)


def test_the_bar_lists_its_outlier_and_enlarges_residuals(html):
    (row,) = table(html, "Points of the bar")
    assert row[0] == "point 9"
    assert number(row[2]) == -60.0
    assert "their distance from the fitted circle enlarged 2 000 times" in words_of(html)


@pytest.mark.usefixtures("unprinted")
def test_missing_bar_calibration_and_origin_are_reported_as_unknown(page):
    html = page(result(compensated=False, origin=False, bar=False, left_out=()))
    text = words_of(html)
    assert 'id="bar-1"' not in html
    assert "The zero point is unknown: the known points of the planes do not determine the position" in text
    assert "Not determined: EX, EY and EZ. Reported as unknown, not as zero." in text
    assert "The readings were not compensated for the tilt of the planes (up to 30°)" in text
    assert "No map: the readings were evaluated without an inclination calibration." in text
    assert "nan" not in text.lower().split()
    assert html.count("<figure") == 3


def extras_of(errors):
    return sorted(set(errors.data_vars) - {"covariance", *DOF})


@pytest.mark.usefixtures("unprinted")
@pytest.mark.parametrize("part", [slice(i, None, 8) for i in range(8)] + [slice(None)])
def test_whatever_extra_is_missing_the_rest_is_reported(page, part):
    errors = result()
    html = page(errors.drop_vars(extras_of(errors)[part]))
    assert 'id="provenance-1"' in html
    assert "nan" not in words_of(html).lower().split()


def test_extras_of_only_nan_are_treated_as_missing(page):
    errors = result()
    for name in extras_of(errors):
        if errors[name].dtype.kind == "f":
            errors[name] = errors[name] * np.nan
    html = page(errors)
    assert "The direction could not be determined." in words_of(html)
    assert "nan" not in words_of(html).lower().split()


@pytest.mark.usefixtures("undrawn")
def test_strokes_are_read_from_the_raw_dataset(page):
    errors = result()
    raw = xr.Dataset({"stage": errors["stage"]})
    (row,) = table(page(errors.drop_vars("stage"), raw=raw), "Readings that were left out")
    assert row[1] == "X"


@pytest.mark.usefixtures("unprinted")
def test_two_planes_have_no_closure(page):
    html = page(result(PLANES[:2]))
    assert "Two planes always fit a beam exactly: their closures are 0 by definition" in words_of(html)


@pytest.mark.usefixtures("undrawn")
def test_contradicting_planes_are_a_warning(page):
    errors = result()
    errors["closure"][2] = 20 * errors["closure_uncertainty"][2]
    html = page(errors)
    assert "plane 3 by 20.0 times its standard uncertainty" in re.search(r'<p class="warning">(.*?)</p>', html)[1]


@pytest.mark.usefixtures("unprinted")
def test_the_rotation_about_the_beam_is_reported_as_unknown(page):
    errors = result()
    along = np.array([[0.0, 0.0, -1.0]])
    errors["nominal_direction"][:] = along
    errors["beam_direction"][:] = along + np.array([2e-3, -1e-3, 0])
    errors["EC"][:] = np.nan
    errors["covariance"][:, 5] = errors["covariance"][:, :, 5] = np.nan
    html = page(errors)
    assert "the rotation of a beam about its own axis cannot be measured" in words_of(html)
    assert "Not determined: EC." in words_of(html)


@pytest.mark.usefixtures("undrawn")
def test_remarks_of_the_method_are_warnings(page):
    errors = result().assign_attrs(notes=["The compensation took 4 iterations."])
    assert '<p class="warning">The compensation took 4 iterations.</p>' in page(errors)


@pytest.mark.usefixtures("unprinted")
def test_many_planes_are_reported_and_some_are_drawn(page):
    html = page(result(tuple((20, angle) for angle in range(0, 360, 24))))
    assert len(table(html, "The planes.")) == 15
    assert "12 of 15 planes are shown." in words_of(html)


@pytest.fixture(scope="module")
def measured():
    """Return readings of a virtual sine gauge and a check bar, with one outlier and one reading out of range."""
    machine = VirtualMachine("cframe", seed=3)
    faces = [(20 * DEGREE, angle * DEGREE) for angle in (0, 90, 180, 270)]
    raw = simulation.raw(machine, faces, seed=1, check_bar=True, count=12)
    raw["distance"][0, 4] += 40e-6
    raw["distance"][2, 0] = 10.2e-3
    return raw


@pytest.mark.usefixtures("unprinted")
def test_a_result_of_the_method_is_reported_completely(page, measured):
    errors = BeamDirection().identify(
        measured, BeamDirectionSettings(compensation="lk-h050", extrapolate=True, ordered=False)
    )
    html = page(errors, raw=measured)
    text = words_of(html)
    assert "SIMULATED DATA" in text
    assert html.count("<figure") == 6
    assert "nan" not in text.lower().split()
    assert [(row[0], row[1], row[5]) for row in table(html, "Readings that were left out")] == [
        ("plane 1, reading 5", "X", "outlier"),
        ("plane 3, reading 1", "X", "out of range"),
    ]
    bar = {row[0]: row[2] for row in table(html, "Check bar measured")}
    assert number(bar["radius"]) == pytest.approx(1e3 * float(errors["bar_radius_fitted"]), abs=5.1e-5)
    assert bar["known radius of the bar"] == "25.0000"
    groups = {"inclination calibration", "known points of the planes", "triangulation plane"}
    assert {row[0] for row in table(html, "Uncertainty budget")[:3]} == groups


@pytest.mark.usefixtures("undrawn")
def test_a_result_without_compensation_is_reported_with_contradicting_planes(page, measured):
    html = page(BeamDirection().identify(measured, BeamDirectionSettings(ordered=False)), raw=measured)
    assert "The readings were not compensated for the tilt of the planes" in words_of(html)
    assert "The planes contradict one another" in words_of(html)
    assert "the triangulation plane is unknown" in words_of(html)


@pytest.mark.usefixtures("undrawn")
def test_a_plan_has_no_chapter_of_results(page):
    errors = result()
    planned = errors.drop_vars(extras_of(errors))  # only the uncertainty, without results
    assert "Direction of the beam" not in page(planned)
