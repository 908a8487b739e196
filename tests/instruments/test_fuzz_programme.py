"""``make fuzz`` keeps the rows that are up to date, and writes those that are not."""

import importlib.util
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest
from fuzzing import Found
from wire_codecs import CODECS

SOURCE = Path(__file__).parents[2] / "tools" / "fuzz.py"


@pytest.fixture(scope="module")
def programme() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz_programme", SOURCE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def body(programme: ModuleType, page: Path) -> str:
    return programme.sections(page)[1].get(programme.TITLE, "")


def test_a_row_is_up_to_date_with_as_many_frames_of_the_same_code_and_without_failures(
    programme: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, (first, second, *_) = tmp_path / "page.md", CODECS
    assert not programme.is_done(body(programme, page), first, 1)
    found = Found(frames=2000, slowest=1e-3, memory=1 << 20, sampled=10, errors=Counter(ProtocolError=3))
    programme.write(page, programme.TITLE, [(first, found)])
    programme.write(page, programme.TITLE, [(second, Found(frames=500, failures=["mutant 7: too slow"]))])
    text = body(programme, page)
    assert "2500 damaged frames of 2 codecs" in text
    assert programme.is_done(text, first, 2000)
    assert not programme.is_done(text, first, 2001)
    assert not programme.is_done(text, second, 500)  # it failed
    monkeypatch.setattr(programme, "code_of", lambda codec: "another")
    assert not programme.is_done(text, first, 2000)


def test_a_row_depends_on_the_code_of_its_kind_of_instrument_and_on_its_reader(programme: ModuleType) -> None:
    codes = {codec.name: programme.code_of(codec) for codec in CODECS}
    assert all(len(code) == 10 for code in codes.values())
    assert codes["capancdt: answers"] != codes["capancdt: blocks"]
    assert len(set(codes.values())) > len(CODECS) // 2


def test_failures_of_a_row_are_deleted_when_it_is_repeated(programme: ModuleType, tmp_path: Path) -> None:
    page, codec = tmp_path / "page.md", CODECS[0]
    programme.write(page, programme.TITLE, [(codec, Found(frames=5, failures=["mutant 7: too slow"]))])
    assert "mutant 7" in body(programme, page)
    programme.write(page, programme.TITLE, [(codec, Found(frames=5))])
    assert "No failure." in body(programme, page)
