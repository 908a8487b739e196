"""The packages of `make lowest` follow from pyproject.toml and the lock file."""

import importlib.util
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("lowest", ROOT / "tools" / "lowest.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_dependency_is_installed_at_its_lower_bound(tool: ModuleType) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [text for texts in project["optional-dependencies"].values() for text in texts]
    pins = tool.pins()
    for text in [*project["dependencies"], *extras]:
        assert text.replace(">=", "==", 1) in pins
    assert all("==" in pin for pin in pins)


def test_a_marker_is_not_removed(tool: ModuleType) -> None:
    assert tool.lowest(["a>=1.2; python_version < '3.13'"]) == ["a==1.2; python_version < '3.13'"]


@pytest.mark.parametrize("text", ["a", "a==1", "a>=1,<2", "a~=1.0"])
def test_a_requirement_without_a_single_lower_bound_is_refused(tool: ModuleType, text: str) -> None:
    with pytest.raises(ValueError, match="expected a requirement such as"):
        tool.lowest([text])


def test_a_tool_that_is_not_locked_is_reported(tool: ModuleType) -> None:
    assert tool.locked(["pytest"], "pytest-xdist==3\npytest==9.1 \\\n") == ["pytest==9.1"]
    with pytest.raises(ValueError, match="expected pytest"):
        tool.locked(["pytest"], "pytest-xdist==3\n")


def test_the_tests_exist(tool: ModuleType) -> None:
    assert [name for name in tool.CORE if not (ROOT / "tests" / name).exists()] == []
