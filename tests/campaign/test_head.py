"""The head of the reports of a run: what bench and campaign state, with the logo, from the file to the page."""

import base64
import json
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import CliRunner
from undrawn import undrawn  # noqa: F401 - a fixture

from errormotion.cli.app import app
from errormotion.datasets.files.runfile import read_run

LOGO = b"\x89PNG\r\n\x1a\nlogo"


@pytest.mark.usefixtures("undrawn")
def test_the_report_of_a_run_has_its_head_and_logo(lab: None, write: Callable[..., Path], tmp_path: Path) -> None:
    (tmp_path / "logo.png").write_bytes(LOGO)
    bench = '[laboratory]\nname = "Room <2>"\nlogo = "logo.png"\n[calibrated_until]\nbar = 2020-01-31\n'
    campaign = write('name = "a"\nsettings = { count = 11 }\n', bench=bench)
    text = campaign.read_text().replace("[[test]]", '[report]\ncustomer = "Works"\nlanguage = "de"\n[[test]]')
    campaign.write_text(text)
    done = CliRunner().invoke(app, ["run", str(campaign), "--json"])
    assert done.exit_code == 0, done.output
    folder = Path(json.loads(done.stdout)["tests"][0]["folder"])
    head = read_run(folder)["head"]
    assert head["laboratory"] == "Room <2>"
    assert head["calibrated_until"] == {"bar": "2020-01-31"}
    assert (folder / "logo.png").read_bytes() == LOGO
    (tmp_path / "logo.png").unlink()  # the run folder needs nothing else
    html = (folder / "report.html").read_text(encoding="utf-8")
    assert base64.b64encode(LOGO).decode() in html
    assert "Room &lt;2&gt;" in html
    assert "<dt>Kunde</dt><dd>Works</dd>" in html
    assert "Die Kalibrierung von bar war bei der Messung abgelaufen" in html
    assert str(tmp_path) not in html  # no private path
    done = CliRunner().invoke(app, ["report", str(folder), "--language", "en", "--xlsx", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["files"] == [str(folder / "report.xlsx")]
    assert "<dt>Customer</dt><dd>Works</dd>" in (folder / "report.html").read_text(encoding="utf-8")
