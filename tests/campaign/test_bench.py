"""A bench opens all instruments or none, and reports failures with their causes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from coded import raises

from errormotion import plugins
from errormotion.campaign.bench import OpenBench
from errormotion.campaign.files import BenchPlan, load_bench
from errormotion.errors import BenchError

SECOND = '[instruments.other]\ndriver = "counter"\naddress = "tcp://10.0.0.5:10001"\n'


@pytest.fixture
def bench(lab: None, write: Callable[..., Path]) -> Callable[[str], BenchPlan]:
    def read(text: str = "") -> BenchPlan:
        return load_bench(write('name = "a"', bench=text).parent / "bench.toml")

    return read


def test_a_bench_returns_its_instruments_by_kind_and_closes_them(bench: Callable[..., BenchPlan]) -> None:
    opened = plugins.get("instruments", "counter").opened
    with OpenBench(bench()) as table:
        assert table.machine == "lab machine"
        assert table.has_kind("counter")
        assert not table.has_kind("thermometer")
        assert table.of_kind("counter").address == "sim://counter"
        assert opened == ["sim://counter"]
        record = table.answers[0].record()
    assert opened == []
    assert record["identity"]["serial_number"] == "17"
    assert record["settings"]["block"] == 100


def test_failed_connections_are_reported_as_a_tree_and_nothing_stays_open(bench: Callable[..., BenchPlan]) -> None:
    with pytest.raises(BenchError) as caught, OpenBench(bench(SECOND + "refuses = true")):
        pass
    assert str(caught.value).splitlines() == [
        "Bench 'Table': 1 of 2 instruments could not be opened.",
        "├── counter (counter, sim://counter): Lab Counter, serial number 17",
        "└── other (counter, tcp://10.0.0.5:10001): tcp://10.0.0.5:10001: nobody listens there",
    ]
    assert plugins.get("instruments", "counter").opened == []


def test_a_missing_or_ambiguous_kind_is_an_error(bench: Callable[..., BenchPlan]) -> None:
    with OpenBench(bench(SECOND)) as table:
        with raises("bench.instrument.missing"):
            table.of_kind("thermometer")
        with raises("bench.instruments.several"):
            table.of_kind("counter")


def test_of_several_instruments_of_a_kind_one_is_chosen_by_name(bench: Callable[..., BenchPlan]) -> None:
    with OpenBench(bench(SECOND + "simulated = false")) as table:
        chosen = {name: table.chosen({"counter": name}) for name in ("counter", "other")}
        assert {name: each.of_kind("counter").address for name, each in chosen.items()} == {
            "counter": "sim://counter",
            "other": "tcp://10.0.0.5:10001",
        }
        assert chosen["other"].all_of_kind("counter").keys() == {"other"}
        assert table.all_of_kind("counter").keys() == {"counter", "other"}
        assert chosen["counter"].virtual
        assert not chosen["other"].virtual
    assert plugins.get("instruments", "counter").opened == []


def test_a_virtual_machine_does_what_the_operator_of_a_real_one_is_requested_to_do(
    bench: Callable[..., BenchPlan],
) -> None:
    asked: list[str] = []
    done: list[tuple[str, dict[str, Any]]] = []
    with OpenBench(bench("simulated = false"), asked.append) as table:
        driver = table.of_kind("counter")
        driver.act = lambda action, **values: done.append((action, values))
        table.ask("Move the tracker.", "set_station", position=[0.1, 0.2, 0.3])
        table.ask("Mount the bar.")
    assert done == [("set_station", {"position": [0.1, 0.2, 0.3]})]
    assert asked == ["Mount the bar."]


def test_the_operator_is_prompted_for_real_instruments_only(bench: Callable[..., BenchPlan]) -> None:
    asked: list[str] = []
    with OpenBench(bench(), asked.append) as table:
        table.ask("Mount the bar.")
    assert asked == []
    with OpenBench(bench("simulated = false"), asked.append) as table:
        table.ask("Mount the bar.")
    assert asked == ["Mount the bar."]
    with (
        OpenBench(bench("simulated = false")) as table,
        raises("operator.request.not_shown"),
    ):
        table.ask("Mount the bar.")
