"""Short warm-ups of virtual machines: simulated control, probe and thermometer, recorder and identification."""

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from armed import CONTROLLER
from coded import raises

from errormotion import datasets
from errormotion.campaign import runner
from errormotion.campaign.bench import OpenBench
from errormotion.campaign.files import CampaignPlan, load_campaign
from errormotion.campaign.folder import RunFolder, list_runs
from errormotion.campaign.planning.expected import expected, planned
from errormotion.campaign.storage.store import committed_length
from errormotion.errors import BenchError, InstrumentTimeoutError, RunError
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.simulators import reset, world
from errormotion.instruments.simulators.device import SimulatedDevice
from errormotion.instruments.simulators.virtual_world.world import VirtualWorld
from errormotion.instruments.thermometer.modbus_temperature import ModbusTemperature
from errormotion.kinematics.iso import DOF
from errormotion.methods.normal_vector import NormalVector
from errormotion.twin import VirtualMachine

SEED = 5
BENCH = """
schema = "errormotion.bench/1"
name = "Probing"
machine = "{kind} (virtual)"

[instruments.control]
driver = "virtual_controller"
arm = true
address = "sim://{kind}/controller?seed=5{control}"

[instruments.probe]
driver = "{driver}"
address = "sim://{kind}/{wire}?seed=5{probe}"
noise = "0.25 um"
{more}

[instruments.thermometer]
driver = "modbus_temperature"
address = "sim://{kind}/logger?seed=5&sensors=spindle_front,ambient{thermometer}"
channels = ["spindle_front", "ambient"]
timeout = "0.1 s"
"""
CAMPAIGN = """
schema = "errormotion.campaign/1"
name = "Warm-up"
bench = "bench.toml"

[[test]]
name = "warm"
method = "normal_vector"
[test.settings]
balls = [{balls}]
touches = 4
order = "forward"
duration = "{minutes} min"
interval = "{interval} min"
schedule = [{{ at = "0 s", spindle_speed = "12000 /min" }}]
tool_axes = "{axes}"
{settings}
"""
PROBE = 'arm = true\nrepeats = 1\napproach_feed = "12 m/min"'
TOUCHES = 12  # of a cycle: four of each of three balls

Lab = Callable[..., tuple[CampaignPlan, Path]]


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    """Return a function that writes a bench and a campaign of a cold cycle and, by default, two warm ones."""

    def write(
        kind: str = "gantry",
        minutes: int = 20,
        interval: int = 10,
        balls: int = 3,
        settings: str = "",
        driver: str = "controller_probe",
        **faults: str,
    ) -> tuple[CampaignPlan, Path]:
        machine = VirtualMachine(kind, seed=SEED)
        mm = [", ".join(f'"{1e3 * x:.3f} mm"' for x in place) for place in machine.balls.nominal[:balls]]
        stated = ", ".join(f'{{ name = "B{i + 1}", centre = [{place}] }}' for i, place in enumerate(mm))
        wires = {"control": "", "probe": "", "thermometer": ""} | faults
        active = driver == "controller_probe"
        wires |= {"driver": driver, "wire": "controller" if active else "printer"}
        wires |= {"more": PROBE if active else 'timeout = "1 s"\nstart_timeout = "1 s"'}
        (tmp_path / "bench.toml").write_text(BENCH.format(kind=kind, **wires))
        text = CAMPAIGN.format(
            balls=stated, minutes=minutes, interval=interval, axes=machine.tool_axes, settings=settings
        )
        (tmp_path / "campaign.toml").write_text(text)
        return load_campaign(tmp_path / "campaign.toml"), tmp_path / "runs"

    yield write
    reset()


def without_control(plan: CampaignPlan) -> CampaignPlan:
    """Remove the control from the bench."""
    bench = plan.folder / "bench.toml"
    before, _, rest = bench.read_text().partition("[instruments.control]")
    bench.write_text(before + "[instruments.probe]" + rest.partition("[instruments.probe]")[2])
    return load_campaign(plan.folder / "campaign.toml")


def here(kind: str = "gantry") -> VirtualWorld:
    """Return the simulated world of the next run, with its true values."""
    return world(kind, SEED)


def one_run(runs: Path) -> RunFolder:
    (run,) = list_runs(runs)
    return run


def raw_of(run: RunFolder) -> xr.Dataset:
    raw = datasets.load(run.raw)
    datasets.validate(raw)
    return raw.load()


def off(errors: xr.Dataset, machine: VirtualMachine) -> np.ndarray:
    """Return the deviations of errors from the truth, in standard uncertainties; (cycle, 6), without the cold cycle."""
    truth = machine.truth_probing(errors["time"].values, errors.attrs["functional_point"])
    values, true = (np.stack([ds[name].values for name in DOF], axis=-1) for ds in (errors, truth))
    u = np.sqrt(np.diagonal(errors["covariance"].values, axis1=1, axis2=2))
    return ((values - true + true[0]) / np.where(u > 0, u, np.nan))[1:]


def breaks_at(monkeypatch: pytest.MonkeyPatch, name: str, number: int, what: Callable[[], Any]) -> None:
    """Run a function before the n-th call of an operation of the controller."""
    usual, calls = getattr(VirtualController, name), []

    def call(self: VirtualController, *arguments: Any, **keywords: Any) -> Any:
        calls.append(name)
        if len(calls) == number:
            what()
        return usual(self, *arguments, **keywords)

    monkeypatch.setattr(VirtualController, name, call)


# A touch on the virtual machine is up to three ways, a search and a slow contact, all of them probing moves.
IN_SECOND_CYCLE = 5 * TOUCHES + 20


# ---------------------------------------------------------------------- truth


@pytest.mark.parametrize(("kind", "unseen"), [("gantry", ""), ("cframe", "EC")])
def test_a_campaign_determines_the_true_errors(lab: Lab, kind: str, unseen: str) -> None:
    machine = here(kind).machine
    plan, runs = lab(kind, minutes=40, interval=20)
    (run,) = runner.run(plan, runs=runs)
    raw, errors = raw_of(run), datasets.load(run.errors)
    datasets.validate(errors)
    np.testing.assert_allclose(raw["time"].values, [0.0, 1200.0, 2400.0], atol=1e-3)
    assert (raw["touch_flag"].values == 0).all()
    assert raw["spindle_speed"].values[0] == 0.0
    # 12000 /min but for the cold cycle and the second one, in which it stands
    assert 0.85 * 12000 < raw["spindle_speed"].values[2] < raw["spindle_speed"].values[1] + 1e-6 < 12000
    assert (np.diff(raw["temperature"].sel(sensor="spindle_front")) > 0).all()
    found = off(errors, machine)
    assert np.isnan(found).any(axis=0).tolist() == [name == unseen for name in DOF]
    assert np.nanmax(np.abs(found)) < 3
    assert float(abs(errors["EZ"][-1])) > 3e-6


def test_a_displaced_ball_is_named(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    virtual = here()
    plan, runs = lab(minutes=30, balls=4)

    def push() -> None:
        virtual.balls = virtual.balls.moved(1, (40e-6, -30e-6, 0.0))

    breaks_at(monkeypatch, "spindle", 4, push)  # turned off, on, off; on again: the warm-up before the third cycle
    (run,) = runner.run(plan, runs=runs)
    errors = datasets.load(run.errors)
    assert "Ball B2 moved before cycle 2 (1200 s)" in str(errors.attrs["notes"])
    # Every cycle shares the cold one's errors: by chance 18 such numbers pass 3 sigma in one run of thirty, 4 in 900.
    assert np.abs(off(errors, virtual.machine)).max() < 4


# ---------------------------------------------------------------------- what breaks a cycle


@pytest.mark.parametrize(
    ("trouble", "message"),
    [("alarm", "in alarm: servo alarm"), ("estop", "emergency stop")],
)
def test_an_error_in_a_cycle_stops_the_machine_and_the_next_cycle_follows_after_recovery(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, trouble: str, message: str
) -> None:
    plan, runs = lab()
    with VirtualController("sim://gantry/controller?seed=5", CONTROLLER) as operator:
        virtual = here()
        break_now = operator.press_estop if trouble == "estop" else lambda: virtual.raise_alarm("servo alarm")
        with monkeypatch.context() as patch:
            breaks_at(patch, "probe", IN_SECOND_CYCLE, break_now)
            with pytest.raises(RunError, match=rf"Touch \d+ of 12 \(item [012]\): .*{message}"):
                runner.run(plan, runs=runs)
        state = operator.state()
        assert not state["running"]
        assert state["commanded_spindle_speed"] == 0
        assert not state["enabled"]
        run = one_run(runs)
        raw = raw_of(run)
        assert raw.sizes["time"] == 2
        made = raw["touch_flag"].values == 0
        assert made[0].all()
        assert 0 < made[1].sum() < TOUCHES
        assert (raw["touch_flag"].values[~made] == 4).all()  # not made
        assert json.loads(raw.attrs["invalid"]) == {"not made": int((~made).sum())}
        with pytest.raises(RunError, match=rf"The machine is in .*{trouble[-4:]}.*; nothing was moved"):
            runner.resume(plan, runs=runs)
        operator.reset()
        (run,) = runner.resume(plan, runs=runs)
        raw = raw_of(run)
        np.testing.assert_allclose(raw["time"].values, [0.0, 600.0, 1200.0], atol=1e-3)
        assert (raw["touch_flag"].values[2] == 0).all()
        # its time went on with the machine's clock, so that its heat is that of the truth
        assert np.nanmax(np.abs(off(datasets.load(run.errors), virtual.machine))) < 3


def test_an_alarm_during_the_warm_up_stops_the_spindle(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    plan, runs = lab()
    with VirtualController("sim://gantry/controller?seed=5", CONTROLLER) as operator:
        breaks_at(monkeypatch, "elapse", 20, lambda: here().raise_alarm("oil is hot"))
        with pytest.raises(RunError, match="in alarm: oil is hot; this occurred during the warm-up"):
            runner.run(plan, runs=runs)
        state = operator.state()
        assert state["commanded_spindle_speed"] == 0
        assert state["time"] < 300  # noticed within seconds, not at the next cycle
    assert raw_of(one_run(runs)).sizes["time"] == 1


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ("no_trip", "probe.touches.missed"),
        ("tripped", "probe.tripped.before"),
    ],
)
def test_a_broken_probe_ends_the_cold_cycle_without_data(lab: Lab, fault: str, code: str) -> None:
    plan, runs = lab(probe=f"&fault={fault}")
    with VirtualController("sim://gantry/controller?seed=5", CONTROLLER) as operator:
        with raises(code):
            runner.run(plan, runs=runs)
        state = operator.state()
        assert not state["running"]
        assert state["commanded_spindle_speed"] == 0
    assert not one_run(runs).raw.exists()


def test_a_missing_ball_ends_the_cold_cycle(lab: Lab) -> None:
    plan, runs = lab()
    virtual = here()
    virtual.balls = virtual.balls.moved(1, (0.0, 0.3, 0.0))
    with raises("probing.cold.touches_too_few"):
        runner.run(plan, runs=runs)


def test_touches_before_a_lost_connection_are_kept_and_the_test_stops(lab: Lab) -> None:
    plan, runs = lab(probe="&fault=disconnect&fault_at=150")
    with VirtualController("sim://gantry/controller?seed=5", CONTROLLER) as operator:
        with pytest.raises(RunError, match=r"Touch \d+ of 12"):
            runner.run(plan, runs=runs)
        assert operator.state()["commanded_spindle_speed"] == 0
    raw = raw_of(one_run(runs))
    assert raw.sizes["time"] == 2
    assert 0 < (raw["touch_flag"].values[1] == 0).sum() < TOUCHES


def test_a_connection_lost_while_the_spindle_rotates_is_reopened_to_stop_it(lab: Lab) -> None:
    plan, runs = lab(control="&fault=disconnect&fault_at=60")
    with VirtualController("sim://gantry/controller?seed=5", CONTROLLER) as operator:
        with raises("connection.lost"):
            runner.run(plan, runs=runs)
        assert 0 < operator.state()["time"] < 600
        assert operator.state()["commanded_spindle_speed"] == 0
    assert raw_of(one_run(runs)).sizes["time"] == 1


def test_a_thermometer_without_answer_for_a_cycle_leaves_a_gap(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    usual, calls = ModbusTemperature.read, []

    def read(self: ModbusTemperature) -> dict[str, float]:
        calls.append(1)
        if len(calls) == 2:
            raise InstrumentTimeoutError("no answer within 0.1 s")
        found = usual(self)
        return found if len(calls) < 3 else {**found, "ambient": float("nan")}

    monkeypatch.setattr(ModbusTemperature, "read", read)
    plan, runs = lab()
    (run,) = runner.run(plan, runs=runs)
    known = np.isfinite(raw_of(run)["temperature"].values)
    assert known.tolist() == [[True, True], [False, False], [True, False]]
    assert run.data["samples"]["invalid"] == {"no answer of thermometer": 2, "ambient unknown": 1}
    assert run.data["status"] == "finished"


# ---------------------------------------------------------------------- going on


def test_an_interrupted_run_with_programs_has_the_data_of_an_uninterrupted_one(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:  # with single touches: tests/faults/test_continued.py
    plan, runs = lab(driver="dprnt", settings='moves = [["1 m", "0 m", "0.5 m"], ["3 m", "0 m", "0.5 m"]]')
    (whole,) = runner.run(plan, runs=runs)
    acquire = NormalVector.acquire

    def killed(self: NormalVector, bench: Any, settings: Any, **keywords: Any) -> Iterator[xr.Dataset]:
        chunks = acquire(self, bench, settings, **keywords)
        yield next(chunks)
        yield next(chunks)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(NormalVector, "acquire", killed)
        with pytest.raises(KeyboardInterrupt):
            runner.run(plan, runs=runs)
    (run,) = runner.resume(runs=runs)
    raw, uninterrupted = raw_of(run), raw_of(whole)
    assert set(raw.variables) == set(uninterrupted.variables)
    for name, whole_values in uninterrupted.variables.items():
        np.testing.assert_array_equal(raw[name].values, whole_values.values, err_msg=str(name))


@pytest.mark.slow
def test_a_killed_process_loses_only_its_present_cycle(
    lab: Lab, command: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, runs = lab(minutes=30, probe="&fault=silence&fault_at=250")  # in the third cycle, which waits for its end
    process = command("run", plan.folder / "campaign.toml", "--runs", runs, "--no-report")
    cycles = 0
    while process.poll() is None and cycles < 2:
        time.sleep(0.02)
        stores = list(runs.glob("*/raw.zarr/zarr.json")) if runs.exists() else []
        cycles = committed_length(stores[0].parent, "time") if stores else 0
    process.kill()
    process.wait()
    before = raw_of(one_run(runs))
    assert before.sizes["time"] == 2
    machine = here().machine
    monkeypatch.setattr(SimulatedDevice, "_silent", lambda _: False)
    (run,) = runner.resume(runs=runs)
    raw = raw_of(run)
    np.testing.assert_allclose(raw["time"].values, 600.0 * np.arange(4), atol=1e-3)
    np.testing.assert_array_equal(raw["touch_time"].values[:2], before["touch_time"].values)
    assert np.abs(off(datasets.load(run.errors), machine)).max() < 4


# ---------------------------------------------------------------------- programs


def test_a_program_that_prints_measures_the_same(lab: Lab) -> None:
    plan, runs = lab(driver="dprnt")
    machine = here().machine
    (run,) = runner.run(plan, runs=runs)
    raw, errors = raw_of(run), datasets.load(run.errors)
    assert (raw["touch_flag"].values == 0).all()
    assert (np.diff(raw["touch_time"].values.ravel()) > 0).all()
    truth = machine.truth_probing(errors["time"].values, errors.attrs["functional_point"])
    # Lines have micrometres: each touch is off by up to 0.5 um, the displacement of the balls by less.
    for name in DOF[:3]:
        np.testing.assert_allclose(errors[name], truth[name] - truth[name][0], atol=1e-6)


def test_an_alarm_while_a_program_runs_ends_the_run_without_false_data(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, runs = lab(driver="dprnt")
    virtual, programs = here(), []
    run_program, elapse = VirtualController.run_program, VirtualController.elapse

    def counted(self: VirtualController, text: str) -> Any:
        programs.append(text)
        return run_program(self, text)

    def alarm_in_second(self: VirtualController, seconds: float) -> None:
        elapse(self, seconds)
        if len(programs) == 2 and virtual.time > 710:  # behind the second of three balls
            virtual.raise_alarm("servo alarm")

    monkeypatch.setattr(VirtualController, "run_program", counted)
    monkeypatch.setattr(VirtualController, "elapse", alarm_in_second)
    with pytest.raises(RunError, match="in alarm: servo alarm; this occurred while its program was executed"):
        runner.run(plan, runs=runs)
    assert not virtual.running
    assert virtual.time < 720
    raw = raw_of(one_run(runs))
    assert (raw["touch_flag"].values[0] == 0).all()
    assert (np.diff(raw["touch_time"].values[raw["touch_flag"].values == 0]) > 0).all()  # no line is taken twice


def test_printed_lines_are_kept_when_the_device_stops_printing(lab: Lab) -> None:
    plan, runs = lab(driver="dprnt", probe="&fault=silence&fault_at=17")
    with pytest.raises(RunError, match=r"Touch 6 of 12 \(item 1\): no line for 1 s"):
        runner.run(plan, runs=runs)
    flags = raw_of(one_run(runs))["touch_flag"].values
    assert (flags.reshape(2, TOUCHES) == 0).sum(axis=1).tolist() == [12, 5]


def test_a_lost_line_loses_only_its_touch(lab: Lab) -> None:
    plan, runs = lab(driver="dprnt", probe="&fault=drop&fault_at=14&fault_every=1000")
    (run,) = runner.run(plan, runs=runs)
    flags = raw_of(run)["touch_flag"].values
    assert np.argwhere(flags).tolist() == [[1, 0, 2]]
    assert run.data["status"] == "finished"


def test_without_a_control_on_the_bench_the_operator_starts_the_warm_up_program(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, runs = lab(driver="dprnt")
    plan = without_control(plan)
    monkeypatch.setattr(OpenBench, "virtual", property(lambda self: False))
    machine, asked = here().machine, []
    with VirtualController("sim://gantry/controller?seed=5", CONTROLLER) as at_the_machine:

        def start(message: str) -> None:
            asked.append(message)
            program = NormalVector().programs(plan.tests[0].settings)["warm_up.nc"]
            at_the_machine.elapse(at_the_machine.run_program(program)["duration"] + 3.0)

        (run,) = runner.run(plan, runs=runs, ask=start)
    assert len(asked) == 1
    assert asked[0].startswith("Start the program warm_up.nc on the machine")
    raw, errors = raw_of(run), datasets.load(run.errors)
    assert (raw["touch_flag"].values == 0).all()
    np.testing.assert_allclose(raw["time"].values, [0.0, 600.0, 1200.0], atol=45)
    # Times count from first touch to first touch; warm cycles begin with the way from the last ball, 3 m at 5 m/min.
    times = errors["time"].values + float(raw.attrs["clock_origin"])
    truth = machine.truth_probing(times, errors.attrs["functional_point"])
    for name in DOF[:3]:
        np.testing.assert_allclose(errors[name], truth[name] - truth[name][0], atol=1e-6)
    assert float(abs(errors["EZ"][-1])) > 3e-6


def test_a_probe_that_moves_the_machine_requires_a_control(lab: Lab) -> None:
    plan, runs = lab()
    plan = without_control(plan)
    with pytest.raises(BenchError, match=r"'controller_probe' moves the machine.*the bench has none"):
        runner.run(plan, runs=runs)
    assert not runs.exists()


def test_a_plan_uses_the_noise_of_the_probe_of_the_bench(lab: Any) -> None:
    def u(**stated: str) -> tuple[float, str]:
        plan, _ = lab(**stated)
        bench = plan.folder / "bench.toml"
        bench.write_text(bench.read_text().replace('noise = "0.25 um"', 'noise = "0.5 um"'))
        plan = load_campaign(plan.folder / "campaign.toml")
        found = planned(plan, plan.tests[0])
        return expected(found)[0]["expanded_uncertainty"], str(found.em.notes[0])

    of_probe, note = u()
    of_settings, _ = u(settings='touch_noise = "0.25 um"')
    assert "a noise of 0.5 um" in note
    assert of_probe == pytest.approx(2 * of_settings)
