"""Every mistake in a bench or campaign file is reported at once: file, key, expected, found, nearest."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from coded import raises

from errormotion.campaign.files import load_bench, load_campaign
from errormotion.errors import BenchError

pytestmark = pytest.mark.usefixtures("lab")


def complaints(path: Path, load: Callable[[Path], object]) -> list[str]:
    with pytest.raises(BenchError) as caught:
        load(path)
    head, *mistakes = str(caught.value).split("\n  - ")
    assert head == f"{path}: {len(mistakes)} mistake" + "s" * (len(mistakes) > 1)
    return mistakes


def test_valid_files_have_settings_in_si_and_defaults(write: Callable[..., Path]) -> None:
    path = write(
        'name = "a"\nsettings = {level = "25 mm"}', 'name = "b"\ninputs = {zero = "a"}', bench='rate = "20 kHz"'
    )
    plan = load_campaign(path)
    assert [test.name for test in plan.tests] == ["a", "b"]
    assert plan.tests[0].settings.level == pytest.approx(0.025)
    assert plan.tests[0].settings.count == 1000
    assert plan.tests[1].inputs == {"zero": "a"}
    assert plan.bench.machine == "lab machine"
    assert plan.bench.instruments[0].address == "sim://counter"
    assert plan.bench.instruments[0].settings.rate == 20000.0


def test_all_mistakes_of_a_bench_file_are_reported_at_once(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(
        'schema = "errormotion.bench/2"\nname = "Table"\n'
        '[instruments.a]\ndriver = "countr"\n'
        '[instruments.b]\ndriver = "counter"\nrate = 20\nblok = 3\n'
        '[instruments.c]\naddress = "tcp://10.0.0.5:10001"\n'
    )
    schema, machine, driver, unknown, rate, block = complaints(path, load_bench)
    assert schema.startswith("schema: expected 'errormotion.bench/1'; found \"errormotion.bench/2\"")
    assert machine == "machine: missing; expected the name of the machine tool, or the table [machine]"
    assert driver.startswith("instruments.c.driver: missing; expected the id of an instrument plugin")
    assert unknown.startswith("instruments.a.driver: No instrument plugin 'countr'")
    assert unknown.endswith("Did you mean 'counter'?")
    assert rate == "instruments.b.rate: expected a frequency with its unit, such as '20 kHz'; found 20"
    assert block.startswith("instruments.b.blok: unknown key; did you mean 'block'?")


def test_all_mistakes_of_a_campaign_file_are_reported_at_once(write: Callable[..., Path]) -> None:
    path = write('name = "a"\nsettings = {level = 25, cuont = 3}', 'name = "a"\ninputs = {zero = "first"}')
    level, unknown, twice, earlier = complaints(path, load_campaign)
    assert level == "test[0].settings.level: expected a length with its unit, such as '5 mm'; found 25"
    assert unknown.startswith("test[0].settings.cuont: unknown key; did you mean 'count'?")
    assert twice == "test[1].name: expected a unique name; found 'a' again"
    assert earlier == "test[1].inputs.zero: expected the name of an earlier test; found 'first'; Known here: a"


def test_an_invalid_folder_name_is_reported_together_with_wrong_settings(write: Callable[..., Path]) -> None:
    name, level = complaints(write('name = "../a"\nsettings = {level = 25}'), load_campaign)
    assert name.startswith("test[0].name: expected ")
    assert name.endswith('; found "../a"')
    assert level.startswith("test[0].settings.level: ")


def test_bench_without_the_instruments_of_a_method_is_refused_before_anything_is_measured(
    write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    from errormotion import plugins

    path = write('name = "a"')
    method = plugins.get("methods", "ramp")
    monkeypatch.setattr(method, "needs", plugins.Needs(("counter", "thermometer"), "errormotion.raw.ramp/1"))
    (mistake,) = complaints(path, load_campaign)
    assert (
        mistake == f"test[0]: the method 'ramp' needs thermometer; the bench {path.parent / 'bench.toml'} has counter"
    )


SECOND = '[instruments.other]\ndriver = "counter"\naddress = "sim://other"\nrate = "50 Hz"\n'


def test_of_several_instruments_of_a_kind_a_test_chooses_one_by_name(write: Callable[..., Path]) -> None:
    plan = load_campaign(
        write(
            'name = "a"\ninstruments = {counter = "other"}',
            'name = "b"\ninstruments = {counter = "counter"}',
            bench=SECOND,
        )
    )
    rates = [plan.bench.chosen(test.instruments).settings_by_kind["counter"].rate for test in plan.tests]
    assert rates == [50.0, 1000.0]


def test_a_choice_that_the_bench_does_not_offer_is_refused(write: Callable[..., Path]) -> None:
    path = write(
        'name = "a"\ninstruments = {counter = "othr"}',
        'name = "b"\ninstruments = {countr = "other"}',
        'name = "c"\ninstruments = {counter = 3}',
        bench=SECOND,
    )
    bench = path.parent / "bench.toml"
    number, name, kind = complaints(path, load_campaign)
    assert number == "test[2].instruments.counter: expected a string in quotes; found 3"
    assert name == (
        f"test[0].instruments.counter: expected the name of a counter on the bench {bench}; found 'othr'; "
        "did you mean 'other'? Known here: counter, other"
    )
    assert kind == (
        f"test[1].instruments.countr: expected a kind of instrument on the bench {bench}; found 'countr'; "
        "did you mean 'counter'? Known here: counter"
    )


def test_several_instruments_of_a_needed_kind_without_a_choice_are_refused(write: Callable[..., Path]) -> None:
    path = write('name = "a"', bench=SECOND)
    (mistake,) = complaints(path, load_campaign)
    assert mistake == (
        f"test[0]: the method 'ramp' needs one counter; the bench {path.parent / 'bench.toml'} has counter, other. "
        'Choose one: instruments = { counter = "counter" }'
    )


def test_runs_folder_elsewhere_is_refused(write: Callable[..., Path]) -> None:
    path = write('name = "a"')
    path.write_text(path.read_text().replace(str(path.parent / "runs"), "s3://bucket/runs"))
    (mistake,) = complaints(path, load_campaign)
    assert mistake.startswith("runs: expected a local folder")


def test_missing_file_is_named(tmp_path: Path) -> None:
    with raises("toml.unreadable"):
        load_bench(tmp_path / "nowhere.toml")


def test_broken_toml_is_reported_with_its_line(write: Callable[..., Path]) -> None:
    path = write('name = "a')
    with pytest.raises(BenchError, match=r"campaign\.toml, line 7, column 10: not TOML"):
        load_campaign(path)


def test_a_missing_calibration_is_reported_when_the_campaign_is_read(tmp_path: Path) -> None:
    source = Path(__file__).parents[2] / "examples" / "virtual_beam"
    shutil.copy(source / "bench.toml", tmp_path)
    shutil.copy(source / "campaign.toml", tmp_path)
    with pytest.raises(BenchError, match=r"test\[0\]\.settings\.compensation: .*lk-h050"):
        load_campaign(tmp_path / "campaign.toml")
    shutil.copytree(source / "calibrations", tmp_path / "calibrations")
    assert load_campaign(tmp_path / "campaign.toml").tests[0].name == "beam"


def test_a_file_of_another_kind_is_reported_as_such(tmp_path: Path) -> None:
    (tmp_path / "bench.toml").write_text('schema = "errormotion.bench/1"\nname = "b"\nmachine = "M"\n')
    (tmp_path / "campaign.toml").write_text('schema = "errormotion.campaign/1"\nname = "c"\nbench = "bench.toml"\n')
    with pytest.raises(BenchError, match=r"expected a campaign file; found a file of kind 'bench'. .* a campaign"):
        load_campaign(tmp_path / "bench.toml")
    with pytest.raises(BenchError, match="expected a bench file; found a file of kind 'campaign'"):
        load_bench(tmp_path / "campaign.toml")
