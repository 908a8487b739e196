"""A continued test that follows another one has the raw data of an undisturbed one, also before its first delivery."""

import contextlib
import itertools
from pathlib import Path

import fault_examples
import fault_trials as trials
import pytest

from errormotion import plugins
from errormotion.campaign import runner
from errormotion.campaign.files import load_campaign
from errormotion.instruments.simulators import reset

METHODS = ("beam_direction", "normal_vector")


def twice(campaign: Path) -> Path:
    """Append the only test of a campaign once more, under another name."""
    text = campaign.read_text(encoding="utf-8")
    head, mark, test = text.partition("[[test]]")
    name = test.split('name = "')[1].split('"')[0]
    campaign.write_text(head + mark + test + "\n" + mark + test.replace(f'"{name}"', '"again"'), encoding="utf-8")
    return campaign


@pytest.mark.slow
@pytest.mark.parametrize("deliveries", [0, 1])
@pytest.mark.parametrize("method", METHODS)
def test_continued_second_test_has_the_raw_data_of_an_undisturbed_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str, deliveries: int
) -> None:
    chosen = {method: fault_examples.SHORT[method]}
    plan = load_campaign(twice(fault_examples.write(tmp_path / "campaigns", chosen)[method]))
    assert len(plan.tests) == 2
    monkeypatch.setattr(runner._Session, "_identify", lambda *_: None)
    runner.run(plan, runs=tmp_path / "undisturbed")
    reset()
    cls = plugins.get("methods", method.partition(",")[0])
    acquire, started = cls.acquire, list[str]()

    def interrupted(self, *arguments, **keywords):
        chunks = acquire(self, *arguments, **keywords)
        started.append(method)
        if len(started) != 2:
            yield from chunks
            return
        yield from itertools.islice(chunks, deliveries)
        if not deliveries:
            next(chunks)  # measured, but not delivered
        chunks.close()
        raise KeyboardInterrupt

    monkeypatch.setattr(cls, "acquire", interrupted)
    with pytest.raises(KeyboardInterrupt):
        runner.run(plan, runs=tmp_path / "runs")
    reset()
    with contextlib.suppress(KeyboardInterrupt):
        runner.resume(runs=tmp_path / "runs")
    assert len(started) == 3
    assert trials.differences(tmp_path / "runs", tmp_path / "undisturbed") == []
