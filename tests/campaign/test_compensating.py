"""A compensation follows the temperatures of a machine, writes only if allowed, and states the reason otherwise."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from coded import raises
from simulated_clock import SimulatedClock

from errormotion import datasets
from errormotion.campaign.compensation.compensating import Compensation, Moment
from errormotion.campaign.compensation.following import AUDIT
from errormotion.campaign.files import BenchCompensator, BenchInstrument, BenchPlan, parse_bench
from errormotion.compensation.online.audit import Verdict, check
from errormotion.compensation.online.follower import State
from errormotion.compensation.online.settings import Limits
from errormotion.compensation.thermal_model import ThermalModel
from errormotion.compensation.thermal_model.features import Feature
from errormotion.compensation.thermal_model.model import Parts
from errormotion.datasets import provenance
from errormotion.errors import BenchError, CompensationError, InstrumentError, RunError
from errormotion.instruments.compensator.modbus_registers import ModbusRegisters
from errormotion.instruments.simulators.compensator.plc import SimulatedPlc
from errormotion.instruments.transports import parse_address
from errormotion.plugins import Applied, Identity, InstrumentInfo, PluginSettings

MACHINE = "Mill 5"
TICK = 0.05
LIMITS = Limits(limit="20 um", slew="20 um/s", period=TICK, oldest="0.3 s", hold="0.3 s", settle="0.15 s")
MOST = LIMITS.slew * TICK
"""Largest change in one period, m."""

STEADY = 20.0
"""Temperature of the start, degC."""


class Thermometer:
    """One temperature that the test sets; None: no answer."""

    info = InstrumentInfo("fake_thermometer", "thermometer", "for tests", "simulated_only")
    Settings = PluginSettings
    channels = ("spindle",)
    value: float | None = STEADY

    def __init__(self, address: str, settings: Any) -> None:
        del address, settings

    def open(self) -> None:
        """Do nothing."""

    close = open

    def identify(self) -> Identity:
        return Identity("tests", "thermometer", "1", simulated=True)

    def read(self) -> dict[str, float]:
        if Thermometer.value is None:
            raise InstrumentError("silent")
        return {"spindle": Thermometer.value}


class Machine:
    """Accepts offsets like a machine with a slew limit; its watchdog is tested with each compensator."""

    info = InstrumentInfo("fake_compensator", "compensator", "for tests", "simulated_only")
    Settings = PluginSettings
    offset = (0.0, 0.0, 0.0)
    busy = fault = ""
    silent = deaf = False
    written: tuple[tuple[float, ...], ...] = ()
    armed = False

    def __init__(self, address: str, settings: Any) -> None:
        del address, settings

    def open(self) -> None:
        if Machine.silent:
            raise InstrumentError("no connection")

    def close(self) -> None:
        """Do nothing."""

    def identify(self) -> Identity:
        return Identity("tests", "machine", "1", simulated=True)

    def arm(self, limit: float) -> None:
        assert limit == LIMITS.limit
        self.armed = True

    def read(self) -> Applied:
        return Applied(Machine.offset, Machine.busy, Machine.fault)

    def write(self, offset: list[float]) -> None:
        assert self.armed
        if Machine.deaf:
            raise InstrumentError("not taken")
        Machine.offset = tuple(offset)  # type: ignore[assignment]
        Machine.written += (tuple(offset),)


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(Thermometer, "value", STEADY)
    for name, value in {"offset": (0.0,) * 3, "busy": "", "fault": "", "silent": False, "deaf": False}.items():
        monkeypatch.setattr(Machine, name, value)
    monkeypatch.setattr(Machine, "written", ())
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def model() -> xr.Dataset:
    """EX = 5 um/K times the temperature of the spindle, trained from 0 to 10 K."""
    feature = Feature("spindle")
    coefficient = np.zeros((6, 1))
    coefficient[0] = 5e-6
    parts = Parts(
        (feature,),
        coefficient,
        np.full((6, 1, 1), 1e-16),
        np.full(6, 1e-7),
        np.ones(6),
        np.ones(6),
        np.array([0.0]),
        np.array([10.0]),
    )
    attrs = {
        "component": "spindle",
        "frame": "machine",
        "machine": MACHINE,
        "reference": "start",
        "functional_point": [0.0, 0.0, 0.0],
        "variant": "lagged",
    }
    return ThermalModel.of(parts, attrs, {}).dataset


@pytest.fixture
def plan() -> BenchPlan:
    head = f'schema = "errormotion.bench/1"\nname = "Shop"\nmachine = "{MACHINE}"\n'
    found = parse_bench(head, Path("bench.toml"))
    instruments = (BenchInstrument("thermometer", Thermometer, "", PluginSettings()),)
    return replace(found, instruments=instruments, compensator=BenchCompensator(Machine, "", PluginSettings(), LIMITS))


Script = dict[int, Callable[[], None]]


def run(compensation: Compensation, script: Script, moments: int) -> list[Moment]:
    """Follow for a number of moments; before moment k, do script[k]."""
    found: list[Moment] = []
    with compensation:
        steps: Iterator[Moment] = compensation.follow()
        for k in range(moments):
            script.get(k, lambda: None)()
            try:
                found.append(next(steps))
            except StopIteration:
                break
    return found


def set_to(owner: type, name: str, value: Any) -> Callable[[], None]:
    return lambda: setattr(owner, name, value)


def states(moments: list[Moment]) -> list[str]:
    """Return the states without repetition."""
    found: list[str] = []
    for moment in moments:
        if not found or found[-1] != str(moment.step.state):
            found.append(str(moment.step.state))
    return found


def never_beyond(start: float = 0.0) -> None:
    course = np.array([(start, 0.0, 0.0), *Machine.written])
    assert (np.abs(course) <= LIMITS.limit * (1 + 1e-9)).all()
    assert (np.abs(np.diff(course, axis=0)) <= 2 * MOST * (1 + 1e-6)).all()


def test_it_follows_the_temperature_and_ramps_to_zero_when_stopped(
    plan: BenchPlan, model: xr.Dataset, tmp_path: Path
) -> None:
    compensation = Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock())
    moments = run(compensation, {3: set_to(Thermometer, "value", STEADY + 2), 30: compensation.stop}, 200)
    assert states(moments) == ["following", "ramping", "off"]
    assert min(offset[0] for offset in Machine.written) == pytest.approx(-10e-6)
    assert Machine.offset == (0.0, 0.0, 0.0)
    never_beyond()
    checked = check(compensation.folder.path / AUDIT)
    assert (checked.verdict, checked.ended) == (Verdict.UNBROKEN, True)
    count = checked.entries
    entries = [json.loads(line)["entry"] for line in (compensation.folder.path / AUDIT).read_text().splitlines()]
    assert len(entries) == count > 10
    assert entries[0]["event"] == "armed"
    assert entries[0]["model"] == provenance.hash_dataset(model)
    assert {"state", "offset", "target", "cause", "inputs"} <= set(entries[5])
    assert entries[-1] == {**entries[-1], "event": "ended", "state": "off"}
    log = datasets.load(compensation.folder.raw)
    assert float(log["temperature"].max()) == STEADY + 2


def test_without_arming_nothing_is_written(plan: BenchPlan, model: xr.Dataset, tmp_path: Path) -> None:
    compensation = Compensation(plan, model, tmp_path, clock=SimulatedClock())
    moments = run(compensation, {3: set_to(Thermometer, "value", STEADY + 2)}, 30)
    assert moments[-1].step.offset[0] == pytest.approx(-10e-6)
    assert Machine.written == ()
    assert json.loads((compensation.folder.path / AUDIT).read_text().splitlines()[0])["entry"]["event"] == "shadow"


@pytest.mark.parametrize(
    ("cause", "text"),
    [
        (None, "no reading for 0.3 s: spindle"),
        (STEADY + 12, "outside the training range: spindle"),
        (math.nan, "no reading for 0.3 s: spindle"),
    ],
    ids=["silent", "outside", "unknown"],
)
def test_without_a_valid_prediction_it_holds_then_ramps(
    cause: float | None, text: str, plan: BenchPlan, model: xr.Dataset, tmp_path: Path
) -> None:
    script = {0: set_to(Thermometer, "value", STEADY), 3: set_to(Thermometer, "value", STEADY + 2)}
    script |= {25: set_to(Thermometer, "value", cause)}
    moments = run(Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock()), script, 80)
    assert states(moments) == ["following", "holding", "ramping", "armed"]
    assert any(text in moment.step.cause for moment in moments)
    assert Machine.offset == (0.0, 0.0, 0.0)
    never_beyond()


def test_a_wide_prediction_is_not_used(plan: BenchPlan, model: xr.Dataset, tmp_path: Path) -> None:
    model["misfit"][1] = 15e-6
    moments = run(
        Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock()),
        {3: set_to(Thermometer, "value", STEADY + 2)},
        8,
    )
    assert states(moments) == ["armed"]
    assert "U of the prediction is 30.0 um" in moments[-1].step.cause


def test_nothing_changes_while_the_machine_is_busy(plan: BenchPlan, model: xr.Dataset, tmp_path: Path) -> None:
    script = {2: set_to(Thermometer, "value", STEADY + 2), 8: set_to(Machine, "busy", "a probing cycle runs")}
    moments = run(Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock()), script, 30)
    assert len({tuple(moment.step.offset) for moment in moments[8:]}) == 1
    assert moments[-1].step.cause == "a probing cycle runs"
    assert 0 < abs(Machine.offset[0]) < 10e-6


def test_a_stop_of_the_machine_ends_it(plan: BenchPlan, model: xr.Dataset, tmp_path: Path) -> None:
    script = {2: set_to(Thermometer, "value", STEADY + 2), 8: set_to(Machine, "fault", "emergency stop")}
    script |= {15: set_to(Machine, "fault", "")}
    moments = run(Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock()), script, 30)
    assert states(moments) == ["following", "fault"]
    assert len(Machine.written) == 8


def test_an_offset_written_by_another_client_ends_it(plan: BenchPlan, model: xr.Dataset, tmp_path: Path) -> None:
    script = {2: set_to(Thermometer, "value", STEADY + 2), 8: set_to(Machine, "offset", (15e-6, 0.0, 0.0))}
    moments = run(Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock()), script, 20)
    assert states(moments) == ["following", "fault"]
    assert "is not the written one" in moments[8].step.cause


def test_after_a_lost_connection_it_continues_from_the_offset_of_the_machine(
    plan: BenchPlan, model: xr.Dataset, tmp_path: Path
) -> None:
    def ramped() -> None:  # what the watchdog of the machine did in the meantime
        Machine.silent, Machine.offset = False, (-4e-6, 0.0, 0.0)

    script = {2: set_to(Thermometer, "value", STEADY + 2), 20: set_to(Machine, "silent", True), 26: ramped}
    moments = run(Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock()), script, 50)
    assert states(moments) == ["following", "fault", "following"]
    again = next(k for k in range(27, 50) if moments[k].step.state is State.FOLLOWING)
    assert moments[again].step.offset[0] == pytest.approx(-4e-6, abs=2 * MOST)
    assert Machine.offset[0] == pytest.approx(-10e-6)


def test_a_stop_is_kept_over_a_lost_connection(plan: BenchPlan, model: xr.Dataset, tmp_path: Path) -> None:
    compensation = Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock())

    def stopped() -> None:
        compensation.stop()
        Machine.silent = True

    script = {2: set_to(Thermometer, "value", STEADY + 2), 20: stopped, 23: set_to(Machine, "silent", False)}
    moments = run(compensation, script, 80)
    assert states(moments) == ["following", "fault", "ramping", "off"]
    assert Machine.offset == (0.0, 0.0, 0.0)
    never_beyond()


def test_stopped_without_a_connection_it_ends(plan: BenchPlan, model: xr.Dataset, tmp_path: Path) -> None:
    compensation = Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock())
    script = {2: set_to(Thermometer, "value", STEADY + 2), 20: set_to(Machine, "silent", True), 30: compensation.stop}
    moments = run(compensation, script, 80)
    assert states(moments) == ["following", "fault"]
    assert moments[-1].snapshot.time - moments[30].snapshot.time == pytest.approx(LIMITS.hold, abs=2 * TICK)


def test_a_plc_follows_and_ramps_to_zero_when_the_program_ends(
    plan: BenchPlan, model: xr.Dataset, tmp_path: Path
) -> None:
    address = f"sim://cframe/plc?clock=0&watchdog=1&slew={2 * LIMITS.slew}&limit={LIMITS.limit}"
    with closing(SimulatedPlc(parse_address(address))) as plc:
        settings = ModbusRegisters.Settings(**plc.driver_settings)
        plan = replace(plan, compensator=BenchCompensator(ModbusRegisters, plc.driver_url, settings, LIMITS))
        script = {k: lambda: plc.machine.elapse(TICK) for k in range(60)}  # the time of the PLC is that of the periods
        script[2] = set_to(Thermometer, "value", STEADY + 1)
        run(Compensation(plan, model, tmp_path, clock=SimulatedClock()), script, 20)
        assert plc.machine.orders == 0
        Thermometer.value = STEADY
        moments = run(Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock()), script, 40)
        assert {"fault", "ramping"}.isdisjoint(states(moments))
        assert plc.machine.offset[0] == pytest.approx(-5e-6, abs=1e-9)
        plc.machine.elapse(2.0)  # the program has ended
        assert plc.machine.offset == (0.0, 0.0, 0.0)


def test_a_rejected_offset_is_a_fault(plan: BenchPlan, model: xr.Dataset, tmp_path: Path) -> None:
    script = {2: set_to(Thermometer, "value", STEADY + 2), 8: set_to(Machine, "deaf", True)}
    moments = run(Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock()), script, 10)
    assert states(moments) == ["following", "fault"]


def test_a_restart_does_not_jump(plan: BenchPlan, model: xr.Dataset, tmp_path: Path) -> None:
    first = Compensation(plan, model, tmp_path, arm=MACHINE)
    run(first, {2: set_to(Thermometer, "value", STEADY + 2)}, 25)
    before = Machine.offset
    assert before[0] == pytest.approx(-10e-6)
    Machine.written = ()
    second = Compensation(plan, model, tmp_path, arm=MACHINE, since=datasets.load(first.folder.raw))
    moments = run(second, {}, 5)
    assert moments[-1].step.offset == pytest.approx(np.array(before), abs=1e-9)
    never_beyond(before[0])


def earlier_by(log: xr.Dataset, seconds: float, **changes: Any) -> xr.Dataset:
    """Return the log of a wall clock that was behind by these seconds."""
    start = datetime.fromisoformat(log.attrs["start"]) - timedelta(seconds=seconds)
    clock = json.loads(log.attrs["clock"])
    clock |= {name: clock[name] - seconds for name in ("wall", "began")} | changes
    return log.assign_attrs(start=start.isoformat(), clock=json.dumps(clock))


@pytest.mark.parametrize("seconds", [3600.0, 86400.0])
def test_a_wall_clock_that_was_set_does_not_change_the_time_since_earlier_readings(
    plan: BenchPlan, model: xr.Dataset, tmp_path: Path, seconds: float
) -> None:
    first = Compensation(plan, model, tmp_path)
    run(first, {}, 5)
    log = earlier_by(datasets.load(first.folder.raw), seconds)
    second = Compensation(plan, model, tmp_path, since=log)
    run(second, {}, 1)
    (begun, *_) = (json.loads(line)["entry"] for line in (second.folder.path / AUDIT).read_text().splitlines())
    assert 0 < begun["since_last_reading"] < seconds / 2


def test_earlier_readings_at_an_unknown_time_are_refused(plan: BenchPlan, model: xr.Dataset, tmp_path: Path) -> None:
    first = Compensation(plan, model, tmp_path)
    run(first, {}, 2)
    log = earlier_by(datasets.load(first.folder.raw), -86400.0, boot="before a restart")
    with raises("compensation.clock.unknown"):
        Compensation(plan, model, tmp_path, since=log)


def test_one_machine_has_one_compensation(plan: BenchPlan, model: xr.Dataset, tmp_path: Path) -> None:
    with Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock()):
        with (
            raises("claim.instrument.used"),
            Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock()),
        ):
            pass
        with Compensation(plan, model, tmp_path, clock=SimulatedClock()):  # a second one may compute
            pass


def test_two_state_folders_do_not_arm_one_output(
    plan: BenchPlan, model: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits = f"watchdog=1&slew={2 * LIMITS.slew}&limit={LIMITS.limit}"
    with closing(SimulatedPlc(parse_address(f"sim://cframe/plc?{limits}"))) as plc:
        port, settings = parse_address(plc.driver_url).port, ModbusRegisters.Settings(**plc.driver_settings)
        first, second = (
            replace(plan, compensator=BenchCompensator(ModbusRegisters, url, settings, LIMITS))
            for url in (f"modbus+tcp://127.0.0.1:{port}", f"modbus+tcp://LOCALHOST:{port}?unit=1")
        )
        with Compensation(first, model, tmp_path / "one", arm=MACHINE, clock=SimulatedClock()) as armed:
            assert "states no owner of its offsets" in armed.note
            monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "other"))
            with (
                pytest.raises(RunError, match=r"is in use by another program: an armed compensation of user"),
                Compensation(second, model, tmp_path / "two", arm=MACHINE, clock=SimulatedClock()),
            ):
                pass
            assert not (tmp_path / "two").exists()


def test_contradictions_are_reported_before_any_connection(plan: BenchPlan, model: xr.Dataset, tmp_path: Path) -> None:
    def made(plan: BenchPlan = plan, **attrs: Any) -> Compensation:
        ds = model.assign_attrs({key: value for key, value in attrs.items() if key != "arm"})
        return Compensation(plan, ds, tmp_path, arm=attrs.get("arm"))

    with pytest.raises(CompensationError, match=r"--arm Mill 6: the machine of bench\.toml is 'Mill 5'"):
        made(arm="Mill 6")
    with raises("compensation.compensator.missing"):
        made(replace(plan, compensator=None), arm=MACHINE)
    with pytest.raises(CompensationError, match="The model is for the machine 'Mill 6'"):
        made(machine="Mill 6")
    with pytest.raises(CompensationError, match="offsets need the frame 'machine'"):
        made(frame="tool")
    wrong = type("Wrong", (Thermometer,), {"channels": ("spindel",)})
    with pytest.raises(BenchError, match="needs the temperatures spindle; found spindel"):
        made(replace(plan, instruments=(BenchInstrument("thermometer", wrong, "", PluginSettings()),)))
    assert not list(tmp_path.glob("*monitor*"))


def test_a_bench_states_its_compensator(tmp_path: Path) -> None:
    head = f'schema = "errormotion.bench/1"\nname = "Shop"\nmachine = "{MACHINE}"\n[compensator]\n'
    text = f'driver = "offset_file"\naddress = "{tmp_path}/offset.json"\nvalid = "3 s"\n'
    found = parse_bench(f'{head}{text}[compensator.limits]\nlimit = "30 um"\n', Path("b.toml")).compensator
    assert found is not None
    assert (found.settings.valid, found.limits.limit) == (3.0, pytest.approx(30e-6))
    for wrong, message in (
        ('driver = "offset_fil"\n', "compensator.driver: No compensator plugin 'offset_fil'.*Did you mean"),
        (f"{text}colour = 1\n", "compensator.colour"),
        (f'{text}[compensator.limits]\nslew = "1 m/s"\n', "compensator.limits.slew"),
    ):
        with pytest.raises(BenchError, match=message):
            parse_bench(head + wrong, Path("b.toml"))


def test_a_frozen_thermometer_holds_then_ramps_and_a_measuring_one_continues(
    plan: BenchPlan, model: xr.Dataset, tmp_path: Path
) -> None:
    noise = np.random.default_rng(5).normal(0.0, 5e-3, 700).round(3)
    script: Script = {
        k: set_to(Thermometer, "value", STEADY + 2 + float(noise[k])) for k in range(700) if not 300 <= k < 500
    }  # for 200 readings the gateway answers with the value of its cache
    compensation = Compensation(plan, model, tmp_path, arm=MACHINE, clock=SimulatedClock())
    first = {0: set_to(Thermometer, "value", STEADY)}
    moments = run(compensation, {**script, **first}, 700)
    assert states(moments) == ["following", "holding", "ramping", "armed", "following"]
    held = next(k for k, moment in enumerate(moments) if moment.step.state is State.HOLDING)
    assert 300 + 60 <= held < 300 + 120
    assert moments[held].step.cause == "spindle repeats one value, in spite of its noise"
    assert not moments[499].step.offset.any()
    assert moments[-1].step.offset[0] == pytest.approx(-10e-6, abs=0.2e-6)
    steps = [each["sensor"] for each in compensation.folder.data["steps"] if each["outcome"] == "doubtful"]
    assert steps == ["spindle"]
    assert "measures again" in compensation.folder.log.read_text()
    never_beyond()
