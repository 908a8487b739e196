"""Words of the code with which pages compare: each exists in the code, and has the mark that it means."""

import re
from pathlib import Path
from typing import get_args

import pytest

pytest.importorskip("bokeh", reason="pip install 'errormotion[dashboard]'")

from errormotion import dashboard
from errormotion.campaign.background.processes import Background, Ended
from errormotion.campaign.compensation.following import Status as Following
from errormotion.campaign.folder import Status
from errormotion.campaign.form.fields import Field
from errormotion.compensation.online.follower import State
from errormotion.compensation.online.settings import Limits
from errormotion.dashboard.pages.compensate import STATES
from errormotion.dashboard.pages.page import _environment
from errormotion.dashboard.watch import Instrument, InstrumentState, Present
from errormotion.tolerances.decision import INSIDE, OPEN, OUTSIDE, WORDS

HERE = Path(dashboard.__file__).parent
SCRIPTS = {path.name: path.read_text() for path in (HERE / "static").glob("*.js")}
TEMPLATES = {path.name: path.read_text() for path in (HERE / "templates").glob("*.j2")}
STYLE = (HERE / "static" / "dashboard.css").read_text()
STATUSES, ENDS, INSTRUMENT_STATES = set(get_args(Status)), set(get_args(Ended)) - {""}, set(get_args(InstrumentState))

OF_THE_CODE = {
    "status": STATUSES,
    "state": {*State},
    "mode": {"shadow", "armed"},
    "unit": {"°C", "mm"},
    "control": {"1"},
}
"""Properties that scripts and templates compare with a text, and the texts that the code gives them."""
OF_THE_BROWSER = {"tagName", "type", "name", "value", "key"}
"""Properties of elements, events and errors of the browser, and of figures of BokehJS, and of figures of BokehJS."""


def _compared(text: str) -> list[tuple[str, str]]:
    """Return the properties of a source that are compared with a text, and the texts."""
    return re.findall(r"([A-Za-z_]+)\s*[!=]==?\s*[\"']([^\"']+)[\"']", text)


@pytest.mark.parametrize("rule", WORDS)
def test_the_mark_of_a_verdict_is_that_of_its_decision(rule: str) -> None:
    shown = _environment().get_template("parts.html.j2").module
    marks = {INSIDE: ("good", "✓"), OUTSIDE: ("bad", "✕"), OPEN: ("open", "?")}
    for decision, word in WORDS[rule].items():
        kind, sign = marks[decision]
        text = str(shown.verdict(word))  # type: ignore[attr-defined]
        assert f'class="mark {kind}"' in text
        assert f">{sign}</span> {word}<" in text


def test_every_text_that_a_page_compares_is_one_of_the_code() -> None:
    found = [(file, *each) for file, text in {**SCRIPTS, **TEMPLATES}.items() for each in _compared(text)]
    assert len(found) > 10
    wrong = [each for each in found if each[1] not in OF_THE_BROWSER and each[2] not in OF_THE_CODE.get(each[1], ())]
    assert not wrong


def test_every_table_of_words_on_a_page_is_that_of_the_code() -> None:
    def keys(text: str, start: str) -> set[str]:
        table = re.search(re.escape(start) + r"\s*\{(.*?)\}[;.\[]", text)
        assert table, start
        return set(re.findall(r"[\"]?(\w+)[\"]?: [\"`]", table.group(1)))

    assert keys(SCRIPTS["now.js"].replace("${clock(each.since)}", ""), "const words =") == INSTRUMENT_STATES
    assert keys(SCRIPTS["measure.js"], "const WORDS =") == ENDS
    assert keys(TEMPLATES["parts.html.j2"], "set kind =") <= STATUSES
    assert tuple(State) == STATES


@pytest.mark.parametrize(
    ("rule", "known"),
    [
        (r"\.states (?:li)?\.(\w+)", {*State, "here"}),
        (r"\.tiles (?:li)?\.(\w+)", INSTRUMENT_STATES | {"said"}),
        (r"\.process \.(\w+)", ENDS | {"state", "note", "message", "links"}),
    ],
)
def test_every_state_that_the_style_names_is_one_of_the_code(rule: str, known: set[str]) -> None:
    found = set(re.findall(rule, STYLE))
    assert found
    assert found <= known


@pytest.mark.parametrize(
    ("file", "name", "fields"),
    [
        ("compensate.js", "status", set(Following.model_fields)),
        ("now.js", "found", set(Present.__dataclass_fields__)),
    ],
)
def test_every_value_that_a_page_reads_is_one_that_the_code_sends(file: str, name: str, fields: set[str]) -> None:
    text = SCRIPTS[file].partition("\nfunction shape")[0]  # other functions have other values of this name
    found = set(re.findall(rf"\b{name}\.(\w+)", text))
    assert found
    assert found <= fields


def test_each_field_and_instrument_that_a_page_shows_is_known() -> None:
    (names,) = re.findall(r"const \{ ([\w, ]+) \} = status\.limits", SCRIPTS["compensate.js"])
    assert set(names.split(", ")) <= set(Limits.model_fields)
    words = set(re.findall(r"\beach\.(\w+)", SCRIPTS["measure.js"]))
    sent = {"elsewhere", "resume", "measuring"}
    assert words <= sent | set(Field.__dataclass_fields__) | set(Background.__dataclass_fields__)
    tile = SCRIPTS["now.js"].partition('"instruments").replaceChildren')[2].partition("parameters-card")[0]
    assert set(re.findall(r"\beach\.(\w+)", tile)) <= set(Instrument.__dataclass_fields__)
