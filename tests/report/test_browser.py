"""The page in a browser: values under the pointer, zoom, and a drawing in space by its script."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from errormotion.report import canvas, write_page, write_report
from errormotion.report.document import Figure, Part, Section, Source
from errormotion.report.drawings.turntable import Dots, Scene, draw

BROWSER = shutil.which("chromium")
NAME = "<script>alert(1)</script>"

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no browser is installed")

ACTIONS = """addEventListener("load", () => {
  const found = [], tip = document.querySelector(".tip"), svg = document.querySelector("figure > svg");
  const panel = svg.querySelector("g.panel"), [x, y, w, h] = panel.dataset.box.split(" ").map(Number);
  svg.setPointerCapture = () => {};
  const act = (kind, px, py) => {
    const at = new DOMPoint(x + px * w, y + py * h).matrixTransform(svg.getScreenCTM());
    svg.dispatchEvent(new PointerEvent(kind, { clientX: at.x, clientY: at.y, button: 0, pointerType: "mouse" }));
  };
  const path = () => panel.querySelector("[data-curve] path").getAttribute("d");
  const whole = path();
  act("pointermove", 0.5, 0.5);
  found.push(tip.innerText);
  act("pointerdown", 0.25, 0.5);
  act("pointermove", 0.75, 0.5);
  act("pointerup", 0.75, 0.5);
  act("pointermove", 0.01, 0.5);
  found.push(tip.innerText, path() !== whole);
  svg.dispatchEvent(new MouseEvent("dblclick"));
  found.push(path() === whole);
  svg.closest("figure").dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
  found.push(tip.innerText);
  const space = document.querySelector(".turn canvas");
  const drawn = space.getContext("2d").getImageData(0, 0, space.width, space.height).data;
  found.push(drawn.some((each) => each > 0), space.getAttribute("aria-label"));
  const log = document.createElement("pre");
  log.id = "log";
  log.append(found.join("|").replaceAll("\\n", ";"));
  document.body.append(log);
});"""


def chapter():
    x = np.linspace(0.0, 100.0, 201)

    def paint(figure):
        axes = canvas.stack(figure, [1.5])[0]
        canvas.curve(axes, x, 2 * x, np.full(x.size, 0.25), colour=canvas.BLUE, name=NAME)
        axes.set_xlim(0, 100)
        axes.set_xlabel("time / min")
        axes.set_title("Z / µm")

    curve = Figure(canvas.draw(paint, "c", canvas.stack_height([1.5])), "Curve.", "A curve.")
    space = Figure(draw(Scene([Dots(np.eye(3), canvas.BLUE, 2.0, [NAME, "b", "c"])]), "s"), "Space.", "Points.")
    return Part("Test", [], [], [Section("a", "A", [curve, space])])


def test_values_zoom_and_space(drift, tmp_path: Path) -> None:
    page = write_page([Source(drift)], lambda: [chapter()], tmp_path / "page.html")
    html = page.read_text(encoding="utf-8")
    html = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", html)  # for the actions of the test
    page.write_text(html.replace("</body>", f"<script>{ACTIONS}</script></body>"), encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    done = subprocess.run(
        [str(BROWSER), *options, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=60, check=True
    )
    found = re.search(r'<pre id="log">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found is not None
    first, zoomed, changed, back, by_key, drawn, label = found[1].split("|")
    name = NAME.replace("<", "&lt;").replace(">", "&gt;")
    assert first == f"time 50.0 min; {name}: 100.0 ± 0.25 µm"
    assert zoomed.startswith("time 25.5")  # the left edge is at 25 min now
    assert by_key.startswith("time 51.0 min;")
    assert (changed, back, drawn, label) == ("true", "true", "true", "Points.")


OVERFLOW = """addEventListener("load", () => {
  const log = document.createElement("pre"), cut = (each) => each.scrollWidth > each.clientWidth + 1;
  log.id = "log";
  log.append([...document.querySelectorAll(".table")].filter(cut).map((each) => each.innerText.slice(0, 80)).join("|"));
  document.body.append(log);
});"""


@pytest.mark.parametrize("method", ["spindle_drift", "other"])
def test_no_column_of_a_table_is_cut_off(drift, tmp_path: Path, method: str) -> None:
    groups = ["uncertainty of the calibration of all five laser sensors", *drift["source_group"].values[1:]]
    errors = drift.assign_attrs(method=method).assign_coords(source_group=("source", groups))
    page = write_report(errors, tmp_path / "page.html")
    html = page.read_text(encoding="utf-8")
    html = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", html)  # for the script of the test
    page.write_text(html.replace("</body>", f"<script>{OVERFLOW}</script></body>"), encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={tmp_path / 'profile'}"]
    done = subprocess.run(
        [str(BROWSER), *options, "--window-size=1200,900", "--dump-dom", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    found = re.search(r'<pre id="log">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found is not None
    assert found[1] == ""
