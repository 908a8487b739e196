"""The page around the chapters: verdict, head of the laboratory, annex; names from files are escaped."""

import base64
import json
import re
from datetime import date

import numpy as np
import pytest

from errormotion.errors import BenchError
from errormotion.report import provenance, settings, write_report, write_run_report
from errormotion.report.document import Source
from errormotion.report.page.head import calibrations, head_of
from errormotion.report.page.verdict import share, verdict
from errormotion.tolerances.conformity import Conformity, Row
from errormotion.tolerances.table import Tolerances

pytestmark = pytest.mark.usefixtures("translated", "undrawn")

HOSTILE = '</style><script>alert("1")</script>'
HEAD = {
    "laboratory": "Measuring room",
    "address": "Main street 1\nTown",
    "customer": "A & B",
    "order": "4711",
    "number": "R-17",
    "calibrated_until": {"frame": "2026-01-31", "bar": "2027-01-31"},
    "certificates": {"bar": "K-117"},
}


def limits(**freedoms):
    table = {name: {"lower": f"-{limit}", "upper": limit} for name, limit in freedoms.items()}
    return Tolerances.model_validate({"freedoms": table})


def written(errors, tmp_path, **run):
    return write_report(errors, tmp_path / "r.html", run=run).read_text(encoding="utf-8")


def visible(html):
    return " ".join(re.sub(r"<[^>]+>", " ", re.sub(r"<style>.*?</style>", "", html, flags=re.S)).split())


def row(value, U, lower, upper, decision=1, name="EX"):
    return Row(name, value, U, "m", lower, upper, U, decision)


def test_the_share_of_a_limit_is_100_at_each_limit():
    inf = np.inf
    for lower, upper in ((-1e-6, 3e-6), (-inf, 2e-6), (2e-6, inf)):
        for limit in (lower, upper):
            if np.isfinite(limit):
                assert share(row(limit, 0, lower, upper)) == pytest.approx(100)
    assert share(row(1e-6, 0, -1e-6, 3e-6)) == pytest.approx(0)
    assert share(row(1e-6, 0, -inf, 2e-6)) == pytest.approx(50)
    assert share(row(1e-6, 0, 2e-6, inf)) > 100
    assert np.isnan(share(row(1e-6, 0, -inf, 0.0)))


def test_the_limit_that_decides_comes_first():
    inside, outside = row(1e-6, 1e-8, -2e-6, 2e-6), row(3e-6, 1e-8, -2e-6, 2e-6, -1, "EY")
    found = verdict([Conformity((inside, outside), (), limits(EX="2 um", EY="2 um"))])
    assert found.tone == "outside"
    assert found.sentence.startswith("1 of 2 limits is exceeded (ISO 14253-1, guard band 1 U (k = 2)): EY is +3.000 ±")
    assert [cells[0] for cells in found.table.rows] == ["EY", "EX"]
    kept = verdict([Conformity((inside,), (), limits(EX="2 um"))])
    assert kept.sentence.startswith("The limit is kept")
    assert verdict([Conformity((), ("A",), limits(EX="2 um"))]) is None


def test_the_verdict_is_first_and_the_annex_last(beams, tmp_path):
    html = written(beams, tmp_path, tolerances=limits(EX="1 um").model_dump(mode="json"))
    places = [html.index(f'id="{name}"') for name in ("verdict", "summary-1", "limits", "provenance-1")]
    assert places == sorted(places)
    assert html.index('class="word"') < html.index('<dl class="facts">')
    assert html.index("<h2>Statement</h2>") < html.index(">Annex<")
    assert "Tolerances: n" in html


def test_the_head_shows_only_statements_of_the_laboratory(beams, tmp_path):
    html = written(beams, tmp_path, head=HEAD, created="2026-03-02T08:00:00+00:00")
    text = visible(html)
    for words in ("Measuring room Main street 1 Town", "Customer A &amp; B", "Order 4711", "Report R-17"):
        assert words in text
    assert "bar K-117 2027-01-31 valid" in text
    assert "frame 2026-01-31 ended" in text
    assert "The calibration of frame ended on 2026-01-31, before the measurement." in text
    assert '@bottom-left { content: "Report R-17"; }' in html
    bare = visible(written(beams, tmp_path))
    facts = bare[: bare.index("Summary")]
    assert "—" not in facts
    assert "Operator" not in facts


def test_a_calibration_is_valid_on_its_last_day():
    head = head_of({"head": {"calibrated_until": {"bar": "2026-03-02"}}})
    assert head.calibrated_until == {"bar": date(2026, 3, 2)}
    assert calibrations(head, "2026-03-02T23:00:00+00:00")[1] == []
    assert len(calibrations(head, "2026-03-03T01:00:00+00:00")[1]) == 1
    assert calibrations(head_of({}), "2026-03-02") is None


def test_hostile_names_in_the_head_are_text(beams, tmp_path):
    head = dict.fromkeys(("laboratory", "address", "accreditation", "customer", "order", "number"), HOSTILE)
    head |= {"calibrated_until": {HOSTILE: "2026-01-31"}, "certificates": {HOSTILE: HOSTILE}}
    html = written(beams, tmp_path, head=head, logo='data:image/png;base64,"><script>')
    assert html.count("<script") == 1  # that of the page
    assert html.count("</style>") == 1
    assert visible(html).count("&lt;script&gt;") >= 6


def test_the_logo_of_a_run_folder_is_embedded(beams, tmp_path, make_drift):
    from errormotion.datasets import save

    (tmp_path / "errors" / "a").mkdir(parents=True)
    save(beams, tmp_path / "errors" / "a" / "errors.nc")
    (tmp_path / "logo.png").write_bytes(b"\x89PNG\r\n\x1a\nrest")
    html = write_run_report(tmp_path).read_text(encoding="utf-8")
    assert base64.b64encode(b"\x89PNG\r\n\x1a\nrest").decode() in html
    (tmp_path / "logo.png").write_bytes(b"GIF89a")
    assert "<img" not in write_run_report(tmp_path).read_text(encoding="utf-8")


def test_settings_are_shown_as_the_campaign_states_them(drift):
    text = '[[test]]\nname = "warm"\n[test.settings]\naverage = "0.5 s"\nschedule = [{ at = "101 min" }]\n'
    run = {"test": "warm", "campaign": {"text": text}}
    rows = provenance.settings_rows(Source(drift, run=run, provenance=provenance.read(drift)))
    found = {name: (value, si) for name, value, si in rows}
    assert found["average"] == ("0.5 s", "0.5 s")
    assert found["schedule.1.at"] == ("101 min", "0 s")
    assert found["schedule.2.at"] == ("101 min", "6060 s")  # not stated: in minutes
    assert settings.field([-0.25, 0.2], "m") == "-250, 200 mm"
    assert settings.field(2.5e-6, "m") == "2.5 µm"
    assert settings.field(None, "m") == ""


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("/srv/j doe/runs/a.csv", "a.csv"),
        ("C:\\Users\\j doe\\a.csv", "a.csv"),
        ("read from /srv/jdoe/a.csv, twice", "read from a.csv, twice"),
        ("../2026-drift/errors.nc", "../2026-drift/errors.nc"),
        ("serial:///dev/ttyUSB0", "serial:///dev/ttyUSB0"),
        ("15000 /min", "15000 /min"),
        ("a/b and 1/min", "a/b and 1/min"),
    ],
)
def test_private_paths_are_reduced_to_the_file(text, shown):
    assert provenance.text(text) == shown


def test_no_private_path_of_a_run_is_printed(beams, tmp_path):
    campaign = {"name": "a", "folder": "/srv/jdoe/secret", "text": "x", "file": "c.toml"}
    html = written(beams, tmp_path, campaign=campaign, inputs={"beams": "/srv/jdoe/other/errors.nc"})
    assert "jdoe" not in html
    assert "c.toml" in html


def test_bench_and_campaign_state_the_head(tmp_path):
    from errormotion.campaign.files import load_bench, load_campaign
    from errormotion.campaign.sections import head

    bench = (
        'schema = "errormotion.bench/1"\nname = "b"\nmachine = "m"\n[laboratory]\nname = "Lab"\nlogo = "l.svg"\n'
        '[instruments.tracker]\ndriver = "leica_emscon"\naddress = "tcp://192.0.2.1:700"\n'
    )
    until = "[calibrated_until]\n{} = 2027-03-01\n"
    (tmp_path / "bench.toml").write_text(bench + until.format("bar"))
    with pytest.raises(BenchError, match=r"laboratory\.logo: .*l\.svg cannot be read"):
        load_bench(tmp_path / "bench.toml")
    (tmp_path / "l.svg").write_text("<svg/>")
    plan = load_bench(tmp_path / "bench.toml")
    assert plan.calibrated_until == {"bar": date(2027, 3, 1)}
    (tmp_path / "campaign.toml").write_text(
        'schema = "errormotion.campaign/1"\nname = "c"\nbench = "bench.toml"\n[report]\ncustomer = "A"\n'
        'language = "de"\n[[test]]\nname = "t"\nmethod = "multilateration"\n'
        '[test.settings.layout]\nlow = ["0 mm", "0 mm", "0 mm"]\nhigh = ["1 m", "1 m", "1 m"]\n'
    )
    campaign = load_campaign(tmp_path / "campaign.toml")
    found = head.stated(plan.laboratory, campaign.report, plan.calibrated_until, {"bar": "K"})
    assert json.loads(json.dumps(found)) == {
        "laboratory": "Lab",
        "customer": "A",
        "language": "de",
        "calibrated_until": {"bar": "2027-03-01"},
        "certificates": {"bar": "K"},
    }
    (tmp_path / "bench.toml").write_text(bench + until.format("baar"))
    with pytest.raises(BenchError, match=r"calibrated_until\.baar: .*did you mean 'bar'"):
        load_bench(tmp_path / "bench.toml")
