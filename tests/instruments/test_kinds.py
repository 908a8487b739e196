"""Kinds of instrument: contracts that plugins can register."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

import pytest

from errormotion import plugins
from errormotion.errors import PluginError
from errormotion.plugins import kind_registry as kinds

PAGE = (Path(__file__).parents[2] / "docs" / "reference" / "kinds.md").read_text()
OF_EVERY_INSTRUMENT = kinds.members(plugins.Instrument).keys()

FOREIGN = """
from typing import Protocol

class Level(Protocol):
    plausible = (-0.1, 0.1)

    def inclination(self) -> float: ...

NOT_A_CONTRACT = 1
"""


@pytest.fixture
def register(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """Install a distribution that registers the kind 'level' as a target."""

    def register(target: str) -> None:
        info = tmp_path / "foreign-1.2.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: foreign\nVersion: 1.2\n")
        (info / "entry_points.txt").write_text(f"[errormotion.kinds]\nlevel = {target}\n")
        (tmp_path / "foreign_kinds.py").write_text(FOREIGN)
        monkeypatch.syspath_prepend(tmp_path)
        kinds.refresh()

    yield register
    monkeypatch.undo()
    sys.modules.pop("foreign_kinds", None)
    kinds.refresh()


def test_a_foreign_kind_is_checked_like_a_built_in_one(register: Callable[[str], None]) -> None:
    assert kinds.kind("level") is None
    register("foreign_kinds:Level")
    assert {"level", "point_lds"} <= set(kinds.kinds())
    contract = kinds.kind("level")
    assert kinds.plausible("level") == (-0.1, 0.1)
    assert kinds.members(contract).keys() == {"inclination"}
    assert kinds.deviations(object(), contract) == ["'inclination' is missing"]


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("foreign_kinds:NOT_A_CONTRACT", "expected a Protocol class at foreign_kinds:NOT_A_CONTRACT; found 1"),
        ("foreign_kinds:Nothing", "does not load: AttributeError"),
    ],
)
def test_a_registered_object_that_is_no_contract_is_refused(
    register: Callable[[str], None], target: str, message: str
) -> None:
    register(target)
    with pytest.raises(PluginError, match=f"The kind 'level'.*{message}"):
        kinds.kind("level")
    assert kinds.kind("point_lds") is not None


@pytest.mark.parametrize("plugin", plugins.available("instruments"), ids=lambda plugin: plugin.id)
def test_every_built_in_instrument_is_of_a_registered_kind(plugin: plugins.Plugin) -> None:
    contract = kinds.kind(plugin.cls.info.kind)
    assert contract is not None
    assert kinds.deviations(plugin.cls("sim://cframe/x"), contract) == []


class Optional(Protocol):
    extra: int

    def act(self, first: int, *, second: int = 0) -> None: ...


class WithOptional(Protocol):
    capabilities = (Optional,)


def test_a_driver_with_the_first_method_of_a_capability_must_have_all() -> None:
    other = type("Other", (), {"extra": 1})()
    assert kinds.deviations(other, WithOptional) == []
    half = type("Half", (), {"act": lambda self, first, *, second=0: None})()
    assert kinds.deviations(half, WithOptional) == ["'extra' is missing (Optional)"]


@pytest.mark.parametrize(
    ("act", "accepted"),
    [
        (lambda self, first, *, second=0: None, True),
        (lambda self, first, second=0, third=0: None, True),
        (lambda self, *given, **named: None, True),
        (lambda self, other, *, second=0: None, False),  # not by the contract's name
        (lambda self, first: None, False),
        (lambda self, first, *, second: None, False),
        (lambda self, first, third, *, second=0: None, False),
    ],
)
def test_a_method_must_take_every_call_that_the_contract_allows(act: Callable[..., None], accepted: bool) -> None:
    driver = type("Driver", (), {"act": act, "extra": 1})()
    assert (kinds.deviations(driver, WithOptional) == []) is accepted


@pytest.mark.parametrize("name", kinds.kinds())
def test_the_reference_names_every_member_of_a_contract(name: str) -> None:
    section = PAGE.partition(f"\n## `{name}`\n")[2].partition("\n## ")[0]
    contract = kinds.kind(name)
    expected = [*(kinds.members(contract).keys() - OF_EVERY_INSTRUMENT)]
    for capability in getattr(contract, "capabilities", ()):
        expected += kinds.members(capability)
    missing = [member for member in expected if f"`{member}" not in section]
    assert section
    assert not missing
