"""``make guided`` and ``make wire`` write their own rows of the page, and keep those of others."""

import importlib.util
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import corpus
import pytest
import wire_trials as trials

TOOLS = Path(__file__).parents[2] / "tools"
OTHER = "# Reliability\n\n## Another programme\n\nIts figures.\n"


def programme(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(TOOLS)
    spec = importlib.util.spec_from_file_location(f"{name}_programme", TOOLS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def test_rows_of_a_guided_search(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    guided, page = programme("guided", monkeypatch), tmp_path / "page.md"
    page.write_text(OTHER)
    names = list(corpus.TARGETS)
    figures = {"good": 10, "all": 20, "kept": 2, "bytes": 9, "errors": {"ProtocolError": 3}}
    figures |= {"faults": [], "slowest": 1e-3, "memory": 2048}
    for name, tried, faults in ((names[2], 50, ["ValueError: x"]), (names[0], 100, []), (names[2], 70, [])):
        guided.write(page, names, {name: guided.row(name, tried, figures)}, {name: faults}, 5.0)
        text = page.read_text()
        assert ("Failures:" in text) == bool(faults or tried == 100)
    assert "170 inputs of 2 codecs and readers of files" in text
    assert "No failure." in text
    assert text.index(f"| {names[0]} | 100 | 10 | 20 | 2, 9 bytes |") < text.index(f"| {names[2]} | 70 |")
    assert text.startswith(OTHER)


def test_rows_of_disturbed_wires(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wire, page = programme("wire", monkeypatch), tmp_path / "page.md"
    page.write_text(OTHER)
    first, second, *_ = names = [case.name for case in trials.cases()]
    row = wire.Row(Counter({"right": 5, "counted": 1, "unknown": 1, "refused": 3, "not reached": 4}))
    row.errors, row.damaged, row.undetected = Counter(ProtocolError=3), 4, 1
    wire.write(page, names, {second: wire.Row(Counter(right=2), faults=["wrong: x"])}, 1)
    wire.write(page, names, {first: row}, 1)
    text = page.read_text()
    assert f"| {first} | 10 | 5 | 2 | 3 | ProtocolError 3 | 1 of 4 |" in text
    assert text.startswith(OTHER)
    assert f"Failures:\n\n* {second}: `wrong: x`" in text
    wire.write(page, names, {second: wire.Row(Counter(right=2))}, 1)
    assert "No failure." in page.read_text()
