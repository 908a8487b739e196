"""A test that was interrupted between any two deliveries of its method has the raw data of an undisturbed one."""

import contextlib
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fault_examples
import fault_trials as trials
import pytest

from errormotion import plugins
from errormotion.campaign import runner
from errormotion.campaign.files import load_campaign
from errormotion.instruments.simulators import reset
from errormotion.methods.spindle_drift.acquisition import drift

SHORTER = {
    "beam_direction": [("speckle =", "readings = 12\nspeckle =")],
    "spindle_drift": [("steps = 21", "steps = 11"), ('"16 min"', '"3 min"'), ('"14 min"', '"2 min"')],
    "crossbeam_scan": [('"140 um"', '"140 um"\ncold_repeats = 0'), ('"7 min", "15 min", "30 min"', '"7 min"')],
    "multilateration": [("[4, 3, 3]", "[2, 2, 2]")],
    "normal_vector": [('"50 min"', '"30 min"'), ('"30 min", spindle', '"20 min", spindle')],
}
"""The interruption follows the second delivery; one or more must remain."""
SAMPLES = 1 << 16
"""Of a delivery of the drift."""


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    found = fault_examples.write(tmp_path_factory.mktemp("campaigns"), fault_examples.SHORT | fault_examples.SECOND)
    for method, changes in SHORTER.items():
        text = found[method].read_text(encoding="utf-8")
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        found[method].write_text(text, encoding="utf-8")
    return found


@pytest.mark.slow  # a run of every method, and another in two parts; only inputs of later tests are identified
@pytest.mark.parametrize("method", fault_examples.SHORT | fault_examples.SECOND)
def test_continued_run_has_the_raw_data_of_an_undisturbed_one(
    campaigns: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    monkeypatch.setattr(drift, "CHUNK_SAMPLES", SAMPLES)
    plan = load_campaign(campaigns[method])
    inputs = {name for test in plan.tests for name in test.inputs.values()}
    identify = runner._Session._identify
    monkeypatch.setattr(
        runner._Session,
        "_identify",
        lambda session, folder, test: identify(session, folder, test) if test.name in inputs else None,
    )
    runner.run(plan, runs=tmp_path / "undisturbed")
    cls = plugins.get("methods", method.partition(",")[0])
    acquire = cls.acquire

    def interrupted(self: Any, *arguments: Any, **keywords: Any) -> Iterator[Any]:
        chunks = acquire(self, *arguments, **keywords)
        if keywords["done"] is not None:
            yield from chunks
            return
        yield from itertools.islice(chunks, 2)
        chunks.close()
        raise KeyboardInterrupt

    monkeypatch.setattr(cls, "acquire", interrupted)
    with pytest.raises(KeyboardInterrupt):
        runner.run(plan, runs=tmp_path / "runs")
    for _ in plan.tests:
        reset()
        with contextlib.suppress(KeyboardInterrupt):
            runner.resume(runs=tmp_path / "runs")
            break
    assert trials.differences(tmp_path / "runs", tmp_path / "undisturbed") == []
