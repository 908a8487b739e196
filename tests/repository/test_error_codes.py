"""Every error of the package has a code of the right form, one for each meaning, and stands in the list."""

from __future__ import annotations

import importlib.util
import re
from collections import defaultdict
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from errormotion.errors import DatasetError, ErrormotionError, InstrumentError, code_of

SCRIPT = Path(__file__).parents[2] / "tools" / "error_codes.py"
STATED = re.compile(r"\bcode=\"([a-z0-9_.]+)\"")
FEWEST = 12
"""Letters of a message that has a meaning without its values."""


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("error_codes", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def source(tool: ModuleType) -> Any:
    return tool.Source()


def test_every_error_of_the_package_has_a_code(tool: ModuleType, source: Any) -> None:
    assert not tool.codeless(source)


def test_one_meaning_has_one_code(tool: ModuleType, source: Any) -> None:
    found = defaultdict(set)
    for site in tool.sites(source):
        if len(re.sub(r"[^a-z]", "", site.template)) >= FEWEST and site.template != tool.OF_CAUSE:
            found[site.kind, site.template].add(site.code)
    assert not {meaning: codes for meaning, codes in found.items() if len(codes) > 1}


def test_a_code_is_not_the_area_of_others(tool: ModuleType, source: Any) -> None:
    codes = {site.code for site in tool.sites(source)}
    assert not {code for code in codes if any(other.startswith(code + ".") for other in codes)}


def test_the_list_has_every_code(tool: ModuleType, source: Any) -> None:
    listed = tool.table(source)
    texts = [path.read_text(encoding="utf-8") for path in tool.PACKAGE.rglob("*.py")]
    stated = {code for text in texts for code in STATED.findall(text)}
    assert len(stated) > 500
    assert not {code for code in stated if f"\n| `{code}` |" not in listed}


def test_the_check_detects_an_error_without_a_code(tool: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "errors.py").write_text("class ErrormotionError(Exception):\n    pass\n")
    (tmp_path / "own.py").write_text(
        f"from {tmp_path.name}.errors import ErrormotionError\n\n\nclass OwnError(ErrormotionError):\n    pass\n\n\n"
        "def fail():\n    return OwnError('no code')\n\n\n"
        "def good():\n    return OwnError('it has', code='own.fault')\n"
    )
    assert [each.partition(" ")[2] for each in tool.codeless(tool.Source(tmp_path))] == ["OwnError('no code')"]


@pytest.mark.parametrize("code", ["", "one", "Two.words", "a.b.c.d.e", "a..b", "a.b ", "bench.Limits", "a.1"])
def test_a_code_of_another_form_is_refused_with_the_message(code: str) -> None:
    with pytest.raises(ValueError, match=r"the lamp is dark: expected a code of two to four dotted words"):
        InstrumentError("the lamp is dark", code=code)


def test_an_error_of_a_plugin_has_the_code_of_its_class() -> None:
    class LampError(InstrumentError):
        code = "lamp.dark"

    assert [LampError("dark").code, LampError("dark", code="lamp.off").code] == ["lamp.dark", "lamp.off"]
    assert [InstrumentError("dark").code, ErrormotionError().code] == ["instrument.other", "error.other"]
    assert [code_of(LampError(), "a.b"), code_of(KeyError(), "a.b")] == ["lamp.dark", "a.b"]


def test_a_class_with_a_code_of_another_form_cannot_be_made() -> None:
    with pytest.raises(ValueError, match=r"class LampError: expected a code"):
        type("LampError", (InstrumentError,), {"code": "Lamp"})


def test_an_error_that_is_restated_keeps_its_code_and_attributes() -> None:
    error = DatasetError("wrong:", ["a", "b"], code="lamp.dark").restated("channel 1: wrong")
    assert (str(error), error.code, error.violations) == ("channel 1: wrong", "lamp.dark", ["a", "b"])
