"""Chapters as data: parts read a dataset, in field units, with uncertainty, reasons of missing values, and limits."""

import re

import numpy as np
import pytest
import xarray as xr

from errormotion import plugins
from errormotion.datasets import build_errors
from errormotion.plugins import FigureOfMerit, Method
from errormotion.report import write_report
from errormotion.report.document import Cell, Figure, Source, Text
from errormotion.report.elements import (
    NOT_DETERMINED,
    Across,
    AgainstLimits,
    Budget,
    Chapter,
    Column,
    Curves,
    FigureBudget,
    KeyFigures,
    KeyValue,
    Map,
    Of,
    On,
    Own,
    PolarPlot,
    Section,
    Sentence,
    Spans,
    Table,
    Timeline,
    TimePanel,
)
from errormotion.report.exports.tables import sheet
from errormotion.report.parts import generic
from errormotion.report.text import signs

pytestmark = pytest.mark.usefixtures("translated")

ANGLES = np.radians(15.0 * np.arange(24))
GAIN, NOISE = 0.3e-6, 0.05e-6
"""Standard uncertainties of EX by a source that all angles share, and by noise, m."""


class Turning(Method):
    """A method outside of this repository, without chapters: it only states its figures."""

    limit: float | None = None

    def figures(self, errors):
        u = float(np.hypot(GAIN, NOISE))
        value = float(errors["EX"][0])
        return [
            FigureOfMerit("EX0C", value, 2 * u, "m", self.limit, {"gain": GAIN}),
            FigureOfMerit("EA0C", 4e-6, 1e-6, "rad"),
        ]


def over_angles(value=20e-6, **more):
    """Return errors over an angle with one source; EB is unknown at the second angle, EC everywhere."""
    values = np.zeros((24, 6))
    values[:, 0] = value * np.cos(2 * ANGLES)
    values[:, 3] = 10e-6 * np.sin(ANGLES)
    values[1, 4] = np.nan
    values[:, 5] = np.nan
    influence = np.zeros((1, 24, 6))
    influence[0, :, 0] = GAIN
    covariance = np.einsum("sni,snj->nij", influence, influence) + NOISE**2 * np.eye(6)
    return build_errors(
        values,
        covariance,
        dims=("angle",),
        coords={"angle": ("angle", ANGLES, {"units": "rad", "long_name": "angle of C"})},
        component="C",
        machine="Five-axis machine",
        frame="machine",
        functional_point=[0, 0, 0],
        reference="axis average line",
        method="turning",
        method_version="1",
        provenance={"settings": {}},
        influence=influence,
        sources=["gain"],
        source_groups=["gain of the sensors"],
        extras={
            "location": xr.DataArray([12e-6, np.nan], dims="line", attrs={"units": "m"}),
            "location_u": xr.DataArray([1e-6, np.nan], dims="line", attrs={"units": "m"}),
            "why": xr.DataArray(["", "the sphere has moved"], dims="line"),
            "residual": xr.DataArray(np.full((24, 2), 3e-7), dims=("angle", "sensor"), attrs={"units": "m"}),
        },
        **more,
    )


@pytest.fixture
def foreign(monkeypatch):
    """Make `Turning` the owner of its datasets."""
    method = type("Own", (Turning,), {})
    known = plugins.owner_of_method
    monkeypatch.setattr(plugins, "owner_of_method", lambda name: method if name == "turning" else known(name))
    return method


def text_of(path):
    return " ".join(re.sub(r"<[^>]+>", " ", path.read_text(encoding="utf-8")).split())


@pytest.mark.usefixtures("foreign")
def test_a_foreign_method_has_its_figures_at_the_head_and_in_a_table(tmp_path):
    page = text_of(write_report(over_angles(), tmp_path / "report.html"))
    head = page[page.index("Summary") : page.index("Figures of merit")]
    assert "EX0C 20.00 µm ± 0.61 µm (k = 2)" in head
    assert "EA0C 0.83 arcsec" in head  # 4 urad
    table = page[page.index("Figures of merit") : page.index("Error motions")]
    assert "EX0C 20.00 ± 0.61 µm" in table
    assert "gain of the sensors 0.300" in table


@pytest.mark.usefixtures("foreign")
def test_a_page_over_an_angle_speaks_of_degrees_and_angles(tmp_path):
    page = text_of(write_report(over_angles(), tmp_path / "report.html"))
    assert "angle / °" in page
    assert "Uncertainty budget at angle 345°" in page
    assert "noise, independent from angle to angle" in page
    assert "EB: determined at 95.83 % of the places." in page
    assert "rad" not in page[: page.index("Annex")].replace("grade", "")
    assert "instant" not in page


def test_budgets_of_other_methods_do_not_speak_of_instants():
    errors = over_angles()
    made = generic.part(Source(errors), "p1")
    (table,) = [block for section in made.sections if section.name == "uncertainty" for block in section.blocks][1:]
    assert any(row[0] == "noise, independent from angle to angle" for row in table.rows)


@pytest.mark.parametrize(("limit", "stated"), [(None, False), (3e-6, False), (1.5e-6, True)])
def test_what_makes_an_uncertainty_large_is_stated(foreign, limit, stated):
    foreign.limit = limit
    made = generic.part(Source(over_angles()), "p1")
    # U = 2 sqrt(0.3^2 + 0.05^2) = 0.608 um: above a third of 1.5 um, below a third of 3 um and half of 20 um.
    words = (
        "U of EX0C is 0.61 µm, which is large against its limit 1.50 µm. Its largest source is 'gain of the sensors' "
        "with 97 % of the variance: a smaller uncertainty of this source would lower it, to 0.10 µm at best."
    )
    assert (words in made.summary) == stated


@pytest.mark.usefixtures("foreign")
def test_an_uncertainty_is_compared_with_the_value_without_a_limit():
    small = generic.part(Source(over_angles(value=1e-6)), "p1")
    assert any(words.startswith("U of EX0C is 0.61 µm, which is large against its value.") for words in small.summary)


def test_a_number_has_no_unit_and_further_figures_are_counted(foreign):
    foreign.figures = staticmethod(
        lambda errors: [FigureOfMerit(f"ratio {k}", 0.1, 0.2, "1", influence={"gain": 0.1}) for k in range(6)]
    )
    (words,) = [each for each in generic.part(Source(over_angles()), "p1").summary if each.startswith("U of")]
    assert words.startswith("U of ratio 0 is 0.20, which is large against its value.")
    assert words.endswith("to 0 at best. The same applies to ratio 1, ratio 2, ratio 3 and 2 more.")


def test_a_limit_of_a_campaign_is_that_of_the_figure(foreign):
    source = Source(over_angles(), limits={"EX*": (-1.5e-6, 1.5e-6)})
    made = generic.part(source, "p1")
    assert made.key_figures[0].note == "limit 1.50 µm"
    assert any("large against its limit 1.50 µm" in words for words in made.summary)
    assert foreign.limit is None


def test_effects_of_sources_follow_from_the_change_of_a_figure(foreign):
    def figures(errors):
        return [FigureOfMerit("first", 2 * float(errors["EX"][0]), 2e-6, "m", 3e-6)]

    foreign.figures = staticmethod(figures)
    words = [each for each in generic.part(Source(over_angles()), "p1").summary if each.startswith("U of first")]
    # The figure is twice an error: 2 * 0.3 um of u = 1 um, 36 % of the variance; the rest is noise.
    assert "'independent noise' with 64 % of the variance: more readings would lower it, to 1.2 µm at best." in words[0]


@pytest.mark.usefixtures("foreign")
def test_figures_that_cannot_be_computed_do_not_prevent_a_report(foreign, tmp_path):
    def figures(errors):
        raise KeyError(errors.attrs["machine"])

    foreign.figures = staticmethod(figures)
    page = text_of(write_report(over_angles(), tmp_path / "report.html"))
    assert "The figures of merit could not be computed: KeyError: &#39;Five-axis machine&#39;." in page
    assert "EXC" in page


def blocks_of(*parts, errors=None):
    source = Source(over_angles() if errors is None else errors)
    return [block for k, part in enumerate(parts) for block in part.blocks(source, f"p{k}")]


def test_a_column_has_the_uncertainty_unit_and_reason_of_its_variable():
    columns = (Column("location", reason="why"), Column("location", "none", "mm", format=".3"), Column("lost"))
    (table,) = blocks_of(Table("Lines of {component}.", columns, over="line"))
    assert table.caption == "Lines of C."
    assert table.head == ["line", "location / µm", "location / mm", "lost"]
    assert table.rows[0][1] == Cell("+12.0", "2.0")
    assert table.rows[0][2] == Cell("+0.012")
    assert table.rows[1][1] == Cell("—", reason="the sphere has moved")
    assert table.rows[1][3].reason == "not part of this result"
    made = sheet(table, 1, "lines")
    assert made.head[:3] == ["line", "location / µm", "U of location / µm"]
    assert made.rows[0][:3] == ["line 1", 12.0, 2.0]


def test_a_column_reduces_the_values_of_a_row():
    columns = (
        Column("residual", unit="nm", reduce="rms", format="3", signed=False),
        Column("EX", reduce="largest", head="EX", signed=False),
    )
    (table,) = blocks_of(Table("Residuals.", columns, over="sensor"))
    assert table.head == ["sensor", "residual / nm", "EX / µm"]
    assert [row[1].text for row in table.rows] == ["300", "300"]
    assert table.rows[0][2].text == "20.00"


def test_rows_are_places_in_field_units():
    (table,) = blocks_of(Table("Errors.", (Column("EX"), Column("EA", unit="urad")), over="angle"))
    assert signs(table.rows[1][0]) == "angle 15°"
    assert table.head == ["angle", "EXC / µm", "EAC / µrad"]
    # EX = 20 um cos(30 deg), u^2 = 0.3^2 + 0.05^2; EA = 10 urad sin(15 deg), u = 0.05 urad.
    assert table.rows[1][1] == Cell("+17.32", "0.61")
    assert table.rows[1][2] == Cell("+2.59", "0.10")


def test_a_part_without_its_variables_is_left_out_or_a_note():
    assert (
        blocks_of(Table("Lost.", (Column("lost"),), over="line"), Curves(variables=("lost",)), PolarPlot(over="turn"))
        == []
    )
    (note,) = blocks_of(Table("Lost.", (Column("lost"),), over="line", absent="No value is lost."))
    assert note.text == "No value is lost."


def test_a_unit_that_is_unknown_is_refused():
    with pytest.raises(ValueError, match="expected one of m, mm, um"):
        blocks_of(Table("Errors.", (Column("EX", unit="inch"),), over="angle"))


def test_several_values_in_a_row_are_refused_without_a_reduction():
    with pytest.raises(ValueError, match="Column 'residual': it has several values over angle in each row"):
        blocks_of(Table("Residuals.", (Column("residual"),), over="sensor"))


def test_curves_leave_out_quantities_over_other_dims():
    (figure,) = blocks_of(Curves(variables=("EX", "location", "EA")))
    assert figure.alt == "Curves over angle: EXC −20.00 to 20.00 µm; EAC −2.06 to 2.06 arcsec."


def test_curves_state_their_bands_and_spans():
    (figure,) = blocks_of(Curves())
    assert "Bands: expanded uncertainty, k = 2." in figure.caption
    assert "Error motions over angle" in figure.caption
    assert "EXC −20.00 to 20.00 µm" in figure.alt
    assert "ECC not observed" in figure.alt
    assert signs("angle / deg") == "angle / °"
    assert 'data-x-unit="°"' in figure.svg
    (plain,) = blocks_of(Curves(band=False))
    assert "Bands" not in plain.caption


def test_a_polar_plot_shows_known_errors_over_a_revolution():
    (figure,) = blocks_of(PolarPlot(variables=("EX", "EC")))
    assert figure.alt == "Polar plots: EXC −20.00 to 20.00 µm."
    # The range of 41.2 um in about five parts: circles at a distance of 10 um.
    assert ">10 µm<" in figure.svg
    assert ">270°<" in figure.svg


def test_the_curve_of_a_revolution_is_closed_and_that_of_a_part_is_not():
    def path(errors):
        (figure,) = blocks_of(PolarPlot(variables=("EX",)), errors=errors)
        (line,) = re.findall(r'd="(M [^"]*)"[^>]*stroke: #0072b2', figure.svg.replace("#0072B2", "#0072b2"))
        return line.count("L")

    whole, half = path(over_angles()), path(over_angles().isel(angle=slice(0, 12)))
    assert (whole, half) == (24, 11)


def test_a_map_is_drawn_over_two_dims():
    errors = build_errors(
        np.random.default_rng(1).normal(0, 1e-6, (3, 4, 6)),
        np.broadcast_to(1e-14 * np.eye(6), (3, 4, 6, 6)),
        dims=("time", "position"),
        coords={"time": [0.0, 1800.0, 3600.0], "position": [0.0, 0.1, 0.2, 0.3]},
        component="Y",
        machine="gantry",
        frame="machine",
        functional_point=[0, 0, 0],
        reference="cold",
        method="other",
        method_version="1",
        provenance={"settings": {}},
    )
    (figure,) = blocks_of(Map("The six errors.", x="time", y="position"), errors=errors)
    assert isinstance(figure, Figure)
    assert "time / min" in figure.svg
    assert "position / mm" in figure.svg
    assert "EXY / µm" in figure.svg
    assert blocks_of(Map("The six errors.", x="time", y="position"), errors=errors.isel(time=[0])) == []


@pytest.mark.usefixtures("foreign")
def test_a_sentence_contains_values_and_is_left_out_if_one_is_missing():
    source = Source(over_angles())
    assert Sentence("Axis {component}: {EX0C}.").text(source) == "Axis C: 20.00 ± 0.61 µm."
    own = {"n": lambda errors: errors.sizes["angle"], "at": Of("EX", select={"angle": 0.0})}
    assert Sentence("{n} angles, {at}.", own).text(source) == "24 angles, +20.00 ± 0.61 µm."
    assert Sentence("Lost: {lost}.").text(source) == ""
    assert Sentence("Never.", when=lambda errors: "lost" in errors).text(source) == ""


@pytest.mark.usefixtures("foreign")
def test_a_chapter_is_a_sequence_of_parts():
    def by_hand(source, key):
        return [Sentence(f"{key} of {source.key}").blocks(source, key)[0]]

    chapter = Chapter(
        "Axis {component}",
        (
            KeyFigures(("EA*",), units={"rad": "urad"}),
            Sentence("Measured at {n} angles.", {"n": lambda errors: errors.sizes["angle"]}),
            Section("budget", "Budget", (FigureBudget(), Own(by_hand))),
            Section("lost", "Lost", (Table("Lost.", (Column("lost"),), over="line"),)),
        ),
    )
    made = chapter.made(Source(over_angles()), "p3")
    assert made.title == "Axis C"
    assert [(each.label, each.value, each.unit) for each in made.key_figures] == [("EA0C", Cell("4.0", "1.0"), "µrad")]
    assert made.summary[0] == "Measured at 24 angles."
    assert [section.name for section in made.sections] == ["budget"]
    assert made.sections[0].blocks[1].text == "p3-budget-1 of p1"


def test_a_row_without_values_states_its_reason_once():
    errors = over_angles().assign(gone=("line", [np.nan, np.nan]))
    columns = (Column("gone", reason="why"), Column("gone", reason="why"))
    (table,) = blocks_of(Table("Gone.", columns, over="line"), errors=errors)
    assert table.rows[1][1:] == [Cell("—", reason="the sphere has moved"), Cell("—")]


def test_parts_read_a_selection_of_the_dataset():
    def half(errors):
        return errors.isel(angle=slice(0, 12)).assign_attrs(half="the first half")

    (table,) = blocks_of(On(half, (Table("Errors of {half}.", (Column("EX"),), over="angle"),)))
    assert table.caption == "Errors of the first half."
    assert len(table.rows) == 12
    assert blocks_of(On(lambda errors: None, (Curves(),))) == []


def test_a_wide_table_has_smaller_letters():
    columns = tuple(Column("EX", head=f"error {k}") for k in range(7))
    narrow, wide = blocks_of(Table("", columns[:5], over="angle"), Table("", columns, over="angle"))
    assert (narrow.wide, wide.wide) == (False, True)
    long = tuple(
        Column(lambda errors: errors["EX"] * 1e3, uncertainty=lambda errors: 0 * errors["EX"] + 1e-9, head="x")
        for _ in range(6)
    )
    (fine,) = blocks_of(Table("", long, over="angle"))  # +20000.000 ± 0.0020, six times
    assert fine.wide


def test_the_span_has_the_decimals_of_its_uncertainty():
    (table,) = blocks_of(Spans())
    by_name = {row[0]: [cell.text if isinstance(cell, Cell) else cell for cell in row] for row in table.rows}
    # U of EA: 2 * 0.05 urad = 0.0206 arcsec; of EX 0.608 um.
    assert (
        by_name["EAC"] == ["EAC", "arcsec", "−2.063", "+2.063", "0.021", "0.021", "100 %"]
        or by_name["EAC"][4] == "0.010"
    )
    assert by_name["EXC"][2:6] == ["−20.00", "+20.00", "0.61", "0.61"]
    assert by_name["ECC"][2:6] == ["—"] * 4


@pytest.mark.parametrize("over", [(), ""])
def test_a_table_without_rows_says_what_is_missing(over):
    with pytest.raises(ValueError, match="table 'Sizes': expected the dims of its rows"):
        Table("Sizes", (Column("noise"),), over)


@pytest.mark.usefixtures("foreign")
def test_parts_on_several_datasets_are_repeated_with_their_own_titles_and_identifiers():
    def halves(errors):
        return [errors.isel(angle=part).assign_attrs(half=name) for name, part in
                (("first", slice(0, 12)), ("second", slice(12, 24)))]  # fmt: skip

    section = Section("half-{half}", "The {half} half", (Curves("The {half} half.", ("EX",)),))
    made = Chapter("Halves", (On(halves, (section,)), On(lambda errors: None, (section,)))).made(Source(over_angles()))
    assert [(each.name, each.title) for each in made.sections] == [
        ("half-first", "The first half"),
        ("half-second", "The second half"),
    ]
    first, second = (each.blocks[0] for each in made.sections)
    assert first.caption.startswith("The first half.")
    ids = [set(re.findall(r' id="([^"]+)"', figure.svg)) for figure in (first, second)]
    assert ids[0]
    assert not ids[0] & ids[1]


def test_a_figure_at_the_head_states_the_standard_in_its_name_below(foreign):
    foreign.figures = lambda self, errors: [
        FigureOfMerit("E of EXX (ISO 230-2)", 2e-6, 1e-7, "m"),
        FigureOfMerit("EXX at P1 while it moved (ISO 230-3)", 2e-6, 1e-7, "m"),
        FigureOfMerit("R of EXX (ISO 230-2)", 2e-6, 1e-7, "m"),
    ]
    source = Source(over_angles())
    made = KeyFigures().key_figures(source)
    assert [(each.label, each.note) for each in made[:2]] == [
        ("E of EXX", "ISO 230-2"),
        ("EXX", "P1 while it moved (ISO 230-3)"),
    ]
    chosen = KeyFigures(lambda errors: [f"{errors.attrs['method'][:0]}R of *"]).key_figures(source)
    assert [each.label for each in chosen] == ["R of EXX"]


def test_figures_against_their_limits_are_shares_with_their_uncertainty(foreign):
    foreign.limit = 40e-6
    (figure,) = AgainstLimits().blocks(Source(over_angles()), "k")
    assert figure.alt == "EX0C 50 %."  # 20 um of 40 um; EA0C has no limit
    foreign.limit = None
    assert AgainstLimits().blocks(Source(over_angles()), "k") == []
    (figure,) = AgainstLimits().blocks(Source(over_angles(), limits={"EA0C": (-8e-6, 8e-6)}), "k")
    assert figure.alt == "EA0C 50 %."  # 4 urad of 8 urad


def test_a_table_across_has_a_column_for_each_place_and_a_row_for_each_run():
    values = 1e-6 * np.arange(33.0).reshape(3, 11)
    values[1, 4] = np.nan
    ds = xr.Dataset(
        {
            "reading": (("run", "target"), values, {"units": "m"}),
            "place": ("target", 0.1 * np.arange(11), {"units": "m"}),
        },
        attrs={"axis": "X"},
    )
    rows = (
        Column("place", head="position", unit="mm", format=".1", signed=False),
        Column("reading", head="run {}"),
        Column("absent"),
    )
    first, second = Across("{axis} by target.", rows, "target", decimals=lambda ds: 2).blocks(Source(ds), "k")
    assert (first.caption, first.head, second.head[1:]) == (
        *("X by target.", ["", *map(str, range(1, 7))], [str(k) for k in range(7, 12)]),
    )
    assert [row[0] for row in first.rows] == ["position / mm", "run 1", "run 2", "run 3"]
    assert [cell.text for cell in second.rows[0][1:]] == ["600.0", "700.0", "800.0", "900.0", "1000.0"]
    assert first.rows[2][1:] == ["11.00", "12.00", "13.00", "14.00", "—", "16.00"]


def test_an_optional_column_is_left_out_and_another_is_dashes():
    ds = xr.Dataset({"known": ("place", [1e-6], {"units": "m"})})
    columns = (
        Column("known"),
        Column("absent"),
        Column("absent", optional=True),
        Column(lambda ds: None, optional=True),
    )
    (table,) = Table("Values.", columns, over="place").blocks(Source(ds), "k")
    assert table.head == ["place", "known / µm", "absent"]
    assert Table("Values.", columns[2:], over="place").blocks(Source(ds), "k") == []


def test_curves_along_a_dim_without_scale_are_drawn_over_their_own_places():
    places = np.array([[0.0, 0.1, 0.3], [0.0, 0.2, 0.6]])
    ds = xr.Dataset(
        {
            "height": (("line", "stop"), 1e-6 * np.array([[1.0, 2, 3], [4, 5, 6]]), {"units": "m"}),
            "distance": (("line", "stop"), places, {"units": "m"}),
        },
        {"line": ["PP0", "NP0"]},
    )
    (figure,) = Curves("Lines.", ("height",), over="stop", band=False, at="distance").blocks(Source(ds), "k")
    assert "distance / mm" in figure.svg
    assert "stop number" not in figure.svg
    first, second = (
        re.search(rf'data-name="{name}"[^>]*>.*?<path d="([^"]+)"', figure.svg, re.DOTALL) for name in ("PP0", "NP0")
    )
    x = [[float(v) for v in re.findall(r"[ML] ([\d.]+) ", found[1])] for found in (first, second)]
    assert x[1][1] - x[1][0] == pytest.approx(2 * (x[0][1] - x[0][0]), abs=0.03)


def test_numbers_at_the_head_are_of_one_value_or_reduced_and_unknown_ones_are_left_out():
    ds = xr.Dataset(
        {
            "residual": (("time", "touch"), 1e-6 * np.array([[3.0, np.nan], [4.0, 0.0]]), {"units": "m"}),
            "ratio": ((), 1.5),
            "lost": ((), np.nan),
        }
    )
    parts = (
        KeyValue(
            "residual", Column("residual", format=".2", signed=False, reduce="rms"), lambda ds: f"{ds.sizes['time']}"
        ),
        KeyValue("ratio", Column("ratio", signed=False), "of two"),
        KeyValue("lost", Column("lost")),
        KeyValue("absent", Column("absent")),
    )
    made = [each for part in parts for each in part.key_figures(Source(ds))]
    assert [(each.label, each.value.text, each.unit, each.note) for each in made] == [
        ("residual", "2.89", "µm", "2"),  # sqrt((9 + 16 + 0) / 3)
        ("ratio", "1.500", "", "of two"),
    ]


def test_the_last_row_of_a_table_reduces_all_values():
    ds = xr.Dataset({"residual": (("ball", "touch"), 1e-6 * np.array([[3.0, np.nan], [4.0, 0.0]]), {"units": "m"})})
    columns = (
        Column("residual", head="rms", format=".2", signed=False, reduce="rms"),
        Column("residual", head="first", format=".0", signed=False, select={"touch": 0}),
    )
    (table,) = Table("Residuals.", columns, over="ball", total="all").blocks(Source(ds), "k")
    assert [[str(getattr(cell, "text", cell)) for cell in row] for row in table.rows] == [
        ["ball 1", "3.00", "3"],
        ["ball 2", "2.83", "4"],
        ["all", "2.89", ""],
    ]


def test_a_column_may_state_a_remark_on_a_known_value_and_the_reasons_of_its_own_selection():
    ds = xr.Dataset(
        {
            "value": (("quantity", "measure"), [[1.0, np.nan], [2.0, 3.0]]),
            "why": (("quantity", "measure"), [["", "too short"], ["", ""]]),
            "step": (("quantity", "measure"), [["", ""], ["", "with a step"]]),
        },
        {"quantity": ["X", "Y"], "measure": ["range", "slope"]},
        {"whole": "whole record (9 min)"},
    )
    columns = [
        Column("value", select={"measure": name}, head=f"{name}, {{whole}}", format=".1", reason="why", note="step")
        for name in ("range", "slope")
    ]
    (table,) = Table("Values.", columns, over="quantity", groups=(("", 1), ("{whole}", 2))).blocks(Source(ds), "k")
    assert [[cell.reason for cell in row[1:]] for row in table.rows] == [["", "too short"], ["", "with a step"]]
    assert table.head[1:] == ["range, whole record (9 min)", "slope, whole record (9 min)"]
    assert table.groups == [("", 1), ("whole record (9 min)", 2)]


def test_panels_over_time_have_the_limits_and_looks_of_their_quantities():
    ds = xr.Dataset(
        {
            "Z": ("time", 1e-6 * np.arange(4.0), {"units": "m"}),
            "lost": ("time", np.full(4, np.nan), {"units": "m"}),
        },
        {"time": ("time", 60.0 * np.arange(4), {"units": "s"})},
        {"functional_point": [0.0, 0.0, 0.1]},
    )
    panels = (
        TimePanel("In Z", "Z", looks={"Z": ("#123456", None)}, limits={"Z": "EZ"}),
        TimePanel("Lost", "lost"),
        TimePanel("Marked", "lost", empty="no valid value"),
    )
    source = Source(ds, limits={"EZ": (-2e-6, 2e-6)})
    (figure,) = Timeline("At ({point}) mm.", panels, temperatures=False).blocks(source, "k")
    assert figure.caption == "At (0.0, 0.0, 100.0) mm."
    assert "#123456" in figure.svg
    assert "limit of EZ" in figure.svg
    assert "no valid value" in figure.svg
    assert "Marked / µm" in figure.svg
    assert "Lost" not in figure.svg
    assert Timeline("Nothing.", panels[1:2], temperatures=False, absent="Nothing is known.").blocks(source, "k") == [
        Text("Nothing is known.", "warning")
    ]


@pytest.mark.usefixtures("foreign")
def test_a_chapter_may_have_a_drawing_beside_its_summary():
    made = Chapter("Turning", (KeyFigures(),), overview=Curves("All.", ("EX",))).made(Source(over_angles()))
    assert made.overview.caption.startswith("All.")
    assert Chapter("Turning", (KeyFigures(),), overview=Curves("None.", ("absent",))).made(
        Source(over_angles())
    ).overview is None  # fmt: skip


def test_groups_of_sources_may_have_further_words_in_the_budget():
    (table,) = Budget(words={"gain of the sensors": "gain"}).blocks(Source(over_angles()), "k")
    assert [row[0] for row in table.rows] == [
        *("gain", "noise, independent from angle to angle", "combined, k = 1", "expanded, k = 2"),
    ]


@pytest.mark.usefixtures("foreign")
def test_errors_that_are_unknown_at_all_places_are_named():
    assert NOT_DETERMINED.text(Source(over_angles())) == "Not determined: ECC. Reported as unknown, not as zero."
    known = over_angles().assign(EC=("angle", np.zeros(24), {"units": "rad"}))
    assert NOT_DETERMINED.text(Source(known)) == ""
