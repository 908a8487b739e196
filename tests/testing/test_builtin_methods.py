"""Every method of this distribution runs the conformance kit in its own tests, with every subject."""

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

from errormotion import plugins
from errormotion.testing import MethodConformance
from errormotion.testing.run import subjects_of

METHODS = Path(__file__).parents[1] / "methods"
OURS = [plugin.id for plugin in plugins.available("methods") if plugin.distribution.startswith("errormotion ")]


@pytest.mark.parametrize("method", OURS)
def test_the_kit_runs_with_every_subject(method: str) -> None:
    spec = spec_from_file_location(f"conformance_of_{method}", METHODS / method / "test_conformance.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    classes = [each for each in vars(module).values() if isinstance(each, type) and issubclass(each, MethodConformance)]
    examined = {each.subject.name for each in classes if each is not MethodConformance}
    assert examined == {subject.name for subject in subjects_of("methods", method)}


def test_the_result_of_a_seed_is_identified_once() -> None:
    (subject,) = subjects_of("methods", "beam_direction")
    assert subject.outcome(0) is subject.outcome(0)
