"""A test that was interrupted between any two deliveries of its method has the raw data of an undisturbed one."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fault_examples
import fault_trials as trials
import pytest

from errormotion import plugins
from errormotion.campaign import runner
from errormotion.campaign.files import load_campaign
from errormotion.campaign.folder import list_runs
from errormotion.instruments.simulators import reset


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return fault_examples.write(tmp_path_factory.mktemp("campaigns"))


@pytest.mark.slow  # a run of every method, and another in two parts
@pytest.mark.parametrize("method", fault_examples.SHORT)
def test_continued_run_has_the_raw_data_of_an_undisturbed_one(
    campaigns: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    plan = load_campaign(campaigns[method])
    runner.run(plan, runs=tmp_path / "undisturbed")
    cls = plugins.get("methods", method.partition(",")[0])
    acquire = cls.acquire

    def interrupted(self: Any, *arguments: Any, **keywords: Any) -> Iterator[Any]:
        chunks = acquire(self, *arguments, **keywords)
        for _ in range(2):
            chunk = next(chunks, None)
            if chunk is None:
                return
            yield chunk
        chunks.close()
        raise KeyboardInterrupt

    parts = 0
    while not list_runs(tmp_path / "runs") or not list_runs(tmp_path / "runs")[-1].finished:
        with monkeypatch.context() as patch:
            if parts < 2:
                patch.setattr(cls, "acquire", interrupted)
            try:
                again = parts and list_runs(tmp_path / "runs")
                runner.resume(runs=tmp_path / "runs") if again else runner.run(plan, runs=tmp_path / "runs")
            except KeyboardInterrupt:
                reset()
        parts += 1
    assert parts > 1
    assert trials.differences(tmp_path / "runs", tmp_path / "undisturbed") == []
