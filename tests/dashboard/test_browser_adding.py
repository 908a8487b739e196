"""Files in Chromium: chosen or dropped on the page Results, corrected, and saved as a run."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from errormotion.campaign.folder import RunFolder

sync_api = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
pytestmark = pytest.mark.slow

DROP = """([name, text]) => {
  const data = new DataTransfer();
  data.items.add(new File([text], name));
  document.getElementById("drop").dispatchEvent(new DragEvent("drop", { dataTransfer: data, bubbles: true }));
}"""


def log(markup: str) -> str:
    """Return a log of two thermometers and a third column, whose titles say which; the names contain markup."""
    lines = [f"Time [s];front [°C];back [°C];{markup.replace(';', ' ')} [°C]"]
    lines += [f"{60 * k};{20 + 0.1 * k:.1f};{21 + 0.1 * k:.1f};{22 + 0.1 * k:.1f}" for k in range(30)]
    return "\n".join(lines) + "\n"


def positioning() -> str:
    """Return a test according to ISO 230-2 as measured, whose last two columns can be confused."""
    lines = ["Position [mm];Deviation 1 [µm];Deviation 2 [µm]"]
    for run in range(5):
        for k, targets in enumerate((range(10, 460, 45), range(415, 0, -45))):
            lines += [f"{t};{0.04 * t - 0.8 * k + 0.1 * ((7 * run + t) % 5):.2f};0.00" for t in targets]
    return "\n".join(lines) + "\n"


def test_a_dropped_file_is_corrected_and_saved(
    page: Any, accessible: Callable[[], None], serving: Callable[..., Any], tmp_path: Path
) -> None:
    served = serving(tmp_path / "runs", control=True)
    served.enter(page, "results")
    page.evaluate(DROP, ["X axis.csv", positioning()])
    page.wait_for_selector("#draft table")
    assert "100 rows" in page.inner_text("#draft caption")
    accessible()
    page.click("#draft-save")  # required answers are missing: the browser does not send them
    assert page.evaluate("document.querySelector('#draft :invalid') !== null")
    page.get_by_label("On which machine was this measured?").fill("Mill 7")
    page.get_by_label("Which axis was measured?").select_option("X")
    error = page.get_by_label("Which error is in column")
    sync_api.expect(error).to_have_value("EXX")
    sync_api.expect(page.get_by_label("On which machine was this measured?")).to_have_value("Mill 7")
    page.click("#draft-save")
    page.wait_for_url("**/run?run=*", timeout=60_000)
    assert "Mill 7" in page.inner_text(".facts")
    [folder] = [RunFolder.open(each.parent) for each in (tmp_path / "runs").glob("*/run.json")]
    assert folder.finished
    assert folder.data["imported"]["files"][0]["name"] == "X axis.csv"


def test_a_file_of_the_record_is_shown_as_such_and_added_once_more(
    page: Any, accessible: Callable[[], None], serving: Callable[..., Any], tmp_path: Path
) -> None:
    served = serving(tmp_path / "runs", control=True)
    for count in (1, 2):
        served.enter(page, "results")
        page.evaluate(DROP, ["X axis.csv", positioning()])
        page.wait_for_selector("#draft table")
        page.get_by_label("On which machine was this measured?").fill("Mill 7")
        page.get_by_label("Which axis was measured?").select_option("X")
        known = page.locator("#draft-known")
        sync_api.expect(known).to_be_visible() if count == 2 else sync_api.expect(known).to_be_hidden()
        accessible()
        page.get_by_role("button", name="Add once more" if count == 2 else "Add as a run").click()
        page.wait_for_url("**/run?run=*", timeout=60_000)
        assert len(list((tmp_path / "runs").glob("*/run.json"))) == count
    served.enter(page, "results")
    page.evaluate(DROP, ["X axis.csv", positioning()])
    sync_api.expect(page.locator("#draft-known a")).to_have_attribute("href", re.compile(r"/run\?run=.+"))
    page.get_by_role("button", name="Cancel").click()
    sync_api.expect(page.locator("#adding")).to_have_attribute("aria-busy", "false")
    assert not list((tmp_path / "runs").glob(".upload-*"))


def test_a_chosen_log_is_shown_without_its_markup_and_a_wrong_file_with_its_reason(
    page: Any, serving: Callable[..., Any], tmp_path: Path, markup: str
) -> None:
    (tmp_path / "log.csv").write_text(log(markup))
    (tmp_path / "letter.txt").write_text("Dear customer,\nthank you.\n")
    served = serving(tmp_path / "runs", control=True)
    served.enter(page, "results")
    page.expected_errors = ("400",)
    page.set_input_files("#files", str(tmp_path / "letter.txt"))
    sync_api.expect(page.locator("#adding-wrong")).to_contain_text("letter.txt")
    page.set_input_files("#files", str(tmp_path / "log.csv"))
    page.wait_for_selector("#draft table")
    sync_api.expect(page.locator("#adding-wrong")).to_be_hidden()
    assert page.evaluate("window.taken") is None
    page.get_by_label("On which machine was this measured?").fill("Mill 7")
    page.click("#draft-save")
    page.wait_for_url("**/run?run=*", timeout=60_000)
    assert page.evaluate("window.taken") is None
