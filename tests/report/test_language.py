"""A report in German: texts of the catalogues, decimal comma, unchanged names of the data."""

import re
import tomllib
from pathlib import Path

import pytest

import errormotion
from errormotion.report import Form, write_report
from errormotion.report.page import assemble
from errormotion.report.page.language import Catalogue
from errormotion.report.text import fixed, listed, written_in

PACKAGE = Path(errormotion.__file__).parent
FILES = sorted(PACKAGE.rglob("de.toml"))
LIMITS = {"EZ": {"lower": {"value": -2e-5, "unit": "m"}, "upper": {"value": 2e-5, "unit": "m"}}}
NAME = '<script>alert("Test")</script>'


@pytest.fixture
def german(tmp_path, monkeypatch):
    """Write a report in German; return its HTML and the texts without translation."""

    def write(errors, **run):
        made = []

        class Recorded(Catalogue):
            def __init__(self, *arguments):
                super().__init__(*arguments)
                made.append(self)

        monkeypatch.setattr(assemble, "Catalogue", Recorded)
        path = write_report(errors, tmp_path / "r.html", run=run, form=Form(language="de"))
        return path.read_text(encoding="utf-8"), list(made[0].missing)

    return write


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.parts[-3])
def test_translations_contain_the_values_of_the_text(file):
    for english, translated in tomllib.loads(file.read_text(encoding="utf-8")).items():
        assert len(re.findall(r"\{\d*\}", translated)) == english.count("{}"), english


def test_every_fixed_text_of_the_page_is_in_the_catalogue():
    template = (PACKAGE / "report/page/templates/report.html.j2").read_text(encoding="utf-8")
    t = Catalogue("de")
    fixed_texts = re.findall(r'"([^"]+)" \| t', template)
    assert len(fixed_texts) >= 12
    for text in fixed_texts:
        t(text)
    assert not t.missing


def test_the_head_of_a_column_is_translated_without_its_unit():
    t = Catalogue("de", [{"excess": "Überhöhung", "excess / %": "Überhöhung in %"}])
    assert t("excess / µm") == "Überhöhung / µm"
    assert t("excess / %") == "Überhöhung in %"
    assert t("surplus / µm") == "surplus / µm"
    assert list(t.missing) == ["surplus / µm"]


def test_a_spindle_report_is_completely_german(german, make_drift):
    drift = make_drift(300).assign_attrs(reference="mean of the record from 4.000 s to 8.000 s")
    html, missing = german(drift, tolerances={"freedoms": LIMITS}, operator="Test")
    assert missing == []
    text = " ".join(re.sub(r"<[^>]+>", " ", re.sub(r"<(style|script)>.*?</\1>", "", html, flags=re.S)).split())
    for words in (
        "Toleranzen: Nichtübereinstimmung nachgewiesen",
        "Der Grenzwert ist überschritten (ISO 14253-1, Schutzabstand 1 U (k = 2)): EZ ist +48,",
        "Prüfer Test",  # a name stays
        "Bezugszustand Mittelwert der Aufzeichnung von 4,000 s bis 8,000 s",
        "Kompensation Z bei 101,0 min ausgeschaltet",
        "Zeit / min",
        "kombiniert, k = 1",
        "Das Budget enthält nur die genannten Quellen.",
    ):
        assert words in text
    assert '<html lang="de">' in html
    assert not re.search(r">[+−]?\d+\.\d+ ?<", html[: html.index('id="provenance-1"')])  # no decimal point
    assert re.search(r"software\.numpy</th>\s*<td[^>]*>\d+\.\d+", html)  # a version is no number


@pytest.mark.usefixtures("undrawn")
def test_an_unknown_language_of_a_campaign_is_english(drift, tmp_path):
    html = write_report(drift, tmp_path / "r.html", run={"head": {"language": "xx"}}).read_text(encoding="utf-8")
    assert '<html lang="en">' in html
    assert "<h2>Summary</h2>" in html


def test_hostile_names_are_text_in_every_language(german, make_drift):
    drift = make_drift(300, machine=NAME)
    drift = drift.assign_coords(sensor=[f"{NAME}{i}" for i in range(5)])
    html, _ = german(drift, operator=NAME, head={"customer": NAME, "number": NAME})
    assert html.count("<script") == 1  # that of the page


def test_a_plugin_has_its_own_catalogue():
    t = Catalogue("de", [{"Gauge of {} at {}.": "Bei {2} Lehre von {1}.", "Summary": "Kurzfassung"}])
    assert t("Gauge of 2.5 µm at X <b>. Reported as unknown, not as zero.") == (
        "Bei X <b> Lehre von 2,5 µm. Als unbekannt angegeben, nicht als Null."
    )
    assert t("Summary") == "Zusammenfassung"  # the words of the page are the same in every report
    assert t("What nobody lists.") == "What nobody lists."
    assert list(t.missing) == ["What nobody lists."]


@pytest.mark.parametrize(
    ("text", "english", "german"),
    [
        ("28.09 um", "28.09 µm", "28,09 µm"),
        ("EX / um", "EX / µm", "EX / µm"),
        ("um", "µm", "µm"),
        ("p = 0.91", "p = 0.91", "p = 0,91"),
        ("-2 % to 10.5 %", "−2 % to 10.5 %", "−2 % bis 10,5 %"),
        ("0.00 to -2.29", "0.00 to −2.29", "0,00 bis −2,29"),
        ("20 degC", "20 °C", "20 °C"),
        ("angle 7.5 deg, sphere 2", "angle 7.5°, sphere 2", "angle 7,5°, sphere 2"),
        ("deg", "deg", "deg"),
        ("2026-11-24 04:01", "2026-11-24 04:01", "2026-11-24 04:01"),
        ("0003.066.087", "0003.066.087", "0003.066.087"),
        ("127.0.0.1", "127.0.0.1", "127.0.0.1"),
        ("1e-07", "1e-07", "1e-07"),
        ("drift - balls 2-3", "drift - balls 2-3", "drift - balls 2-3"),
    ],
)
def test_signs_and_numbers_of_names_and_cells(text: str, english: str, german: str):
    assert Catalogue("en").word(text) == english
    assert Catalogue("de").word(text) == german


def test_numbers_and_enumerations_follow_the_language():
    with written_in("de"):
        assert fixed(-1.25, 1) == "−1,3"
        assert listed(["a", "b", "c"]) == "a, b und c"
    assert fixed(-1.25, 1) == "−1.3"
