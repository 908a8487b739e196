"""A machine at a real address moves only after a person has released its motions; nothing else is asked."""

import re
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
import real_bench
from coded import raises
from forked_commands import Commands
from terminal import Terminal

from errormotion.campaign import runner
from errormotion.campaign.addresses import is_simulated
from errormotion.campaign.background import processes
from errormotion.campaign.files import load_bench, load_campaign
from errormotion.campaign.folder import list_runs
from errormotion.campaign.planning.release import released, to_release
from errormotion.errors import RunError

MOTIONS = "axis-x: the machine will move: X "
WORD = "Type 'move' to release"
Script = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def addresses() -> Iterator[dict[str, str]]:
    with real_bench.devices() as found:
        yield found


@pytest.fixture
def campaign(tmp_path: Path, addresses: dict[str, str]) -> Path:
    return real_bench.write(tmp_path, addresses)


@pytest.fixture(scope="module")
def commands() -> Iterator[Commands]:
    with Commands() as found:
        yield found


@pytest.fixture
def on_terminal(tmp_path: Path, commands: Commands) -> Iterator[Callable[..., Terminal]]:
    started: list[Terminal] = []

    def start(*arguments: str) -> Terminal:
        started.append(Terminal(commands, tmp_path, *arguments, XDG_STATE_HOME=str(tmp_path / "state")))
        return started[-1]

    yield start
    for each in started:
        each.close()


@pytest.fixture
def in_script(commands: Commands) -> Script:
    """Return a function that runs a command without a terminal, with a text as its input."""

    def run(folder: Path, *arguments: str, text: str = "") -> subprocess.CompletedProcess[str]:
        environment = {"XDG_STATE_HOME": str(folder / "state")}
        return commands.run(*arguments, cwd=folder, environment=environment, text=text, timeout=120.0)

    return run


@pytest.mark.slow
@pytest.mark.parametrize("option", [[], ["--yes"], ["--detach"], ["--yes", "--json"]])
def test_without_a_terminal_nothing_moves_unless_it_is_released(
    campaign: Path, in_script: Script, option: list[str]
) -> None:
    found = in_script(campaign.parent, "run", "campaign.toml", *option)
    assert found.returncode == 1, found.stderr
    assert MOTIONS in found.stderr
    assert "--move" in found.stderr
    assert "type 'move'" in found.stderr
    assert not (campaign.parent / "runs").exists()


@pytest.mark.slow
def test_the_option_releases_the_motions_of_a_script(campaign: Path, in_script: Script) -> None:
    found = in_script(campaign.parent, "run", "campaign.toml", "--yes", "--move", "--no-report")
    assert found.returncode == 0, found.stderr
    assert MOTIONS in found.stderr


@pytest.mark.slow
@pytest.mark.parametrize("typed", ["yes", "", "y", "MOVE", "\x04"])
def test_another_word_on_a_terminal_releases_nothing(
    campaign: Path, on_terminal: Callable[..., Terminal], typed: str
) -> None:
    run = on_terminal("run", "campaign.toml", "--yes")
    run.wait_for(WORD)
    assert MOTIONS in run.shown
    assert "(limits -50 mm and 50 mm)" in run.shown
    run.type(typed if typed == "\x04" else f"{typed}\n")
    assert run.end() == 1
    assert "Nothing has moved" in run.shown
    assert not (campaign.parent / "runs").exists()


@pytest.mark.slow
def test_the_word_on_a_terminal_releases_the_motions(campaign: Path, on_terminal: Callable[..., Terminal]) -> None:
    run = on_terminal("run", "campaign.toml", "--no-report")
    run.wait_for(WORD)
    run.type("move\n")
    assert run.end() == 0, run.shown
    assert [each.finished for each in list_runs(campaign.parent / "runs")] == [True]


@pytest.mark.slow
@pytest.mark.parametrize("typed", ["move\n", "\n\nmove\nmove\nmove\n", "move"])
def test_what_was_typed_before_the_question_releases_nothing(
    campaign: Path, on_terminal: Callable[..., Terminal], typed: str
) -> None:
    run = on_terminal("run", "campaign.toml", "--no-report")
    run.type(typed)  # while the command starts
    run.wait_for(WORD)
    time.sleep(2.0)
    assert run.process.poll() is None, run.shown
    assert not (campaign.parent / "runs").exists()
    run.type("\n")
    assert run.end() == 1, run.shown
    assert "Nothing has moved" in run.shown
    assert not (campaign.parent / "runs").exists()


@pytest.mark.slow
def test_the_word_of_a_pipe_releases_nothing(campaign: Path, in_script: Script) -> None:
    found = in_script(campaign.parent, "run", "campaign.toml", text="move\n" * 10)
    assert found.returncode == 1, found.stderr
    assert "Nothing has moved" in found.stderr
    assert not (campaign.parent / "runs").exists()


@pytest.mark.slow
def test_a_background_process_is_released_where_it_is_started(
    campaign: Path, on_terminal: Callable[..., Terminal]
) -> None:
    run = on_terminal("run", "campaign.toml", "--detach")
    run.wait_for(WORD)
    assert not (campaign.parent / "runs").exists()
    run.type("move\n")
    assert run.end() == 0, run.shown
    name = re.search(r"Started as (\S+)\.", run.shown)
    assert name is not None
    (found,) = processes.found(campaign.parent / "runs")
    try:
        assert found.name == name[1]
    finally:
        if found.alive:
            processes.stop(campaign.parent / "runs", found.name)


@pytest.mark.parametrize("change", ["the path", "the address", "nothing"])
def test_a_background_process_moves_only_as_released(campaign: Path, change: str) -> None:
    """The files are changed after the release, before the process has read them."""
    folder, runs = campaign.parent, campaign.parent / "runs"

    def release(motions: Sequence[str]) -> None:
        assert len(motions) == 1
        if change == "the path":
            campaign.write_text(campaign.read_text().replace('"40 mm"', '"45 mm"'))
        elif change == "the address":
            bench = folder / "bench.toml"
            bench.write_text(bench.read_text().replace('machine = "Mill 7"', 'machine = "Mill 8"'))

    name = processes.start(campaign, runs, release)
    deadline = time.monotonic() + 100
    while (found := processes.found(runs)[0]).alive and found.stage != runner.MEASURING and time.monotonic() < deadline:
        time.sleep(0.2)
    if change == "nothing":
        assert (found.name, found.alive, found.stage) == (name, True, runner.MEASURING), found.message
        processes.stop(runs, name)
        while processes.found(runs)[0].alive and time.monotonic() < deadline:
            time.sleep(0.2)
    else:
        assert found.ended == "failed"
        assert "not those that were released" in " ".join(found.message.split())
        assert list_runs(runs) == []


class Stopping(runner.Quiet):
    """Interrupts a run at its first samples."""

    def advance(self, done: float) -> None:
        """Interrupt."""
        raise KeyboardInterrupt


def test_a_continued_run_is_released_again(campaign: Path) -> None:
    plan, runs = load_campaign(campaign), campaign.parent / "runs"
    with pytest.raises(KeyboardInterrupt):
        runner.run(plan, runs=runs, release=released, progress=Stopping())
    (folder,) = list_runs(runs)
    with raises("motions.not_released"):
        runner.resume(plan, runs=runs)
    with raises("motions.not_released"):
        processes.resume(folder.path)
    assert not (runs / ".background").exists()
    asked: list[str] = []
    (folder,) = runner.resume(plan, runs=runs, release=asked.extend)
    assert folder.finished
    assert [line.startswith(MOTIONS) for line in asked] == [True]
    with pytest.raises(RunError, match="Nothing to resume"):
        runner.resume(plan, runs=runs)


def test_an_identified_again_test_needs_no_release(campaign: Path) -> None:
    plan, runs = load_campaign(campaign), campaign.parent / "runs"
    (folder,) = runner.run(plan, runs=runs, release=released)
    folder.save(status="running", errors=None)
    (folder,) = runner.resume(plan, runs=runs)
    assert folder.finished


@pytest.mark.slow
def test_programs_that_move_a_real_machine_are_released_too(
    campaign: Path, on_terminal: Callable[..., Terminal], in_script: Script
) -> None:
    folder = campaign.parent
    refused = in_script(folder, "program", "campaign.toml", "--out", "programs")
    assert (refused.returncode, (folder / "programs").exists()) == (1, False)
    assert "--move" in refused.stderr
    assert in_script(folder, "program", "campaign.toml", "--out", "one", "--move").returncode == 0
    program = on_terminal("program", "campaign.toml", "--out", "two")
    program.wait_for(WORD)
    program.type("move\n")
    assert program.end() == 0, program.shown
    assert next(iter((folder / "one").iterdir())).read_text() == next(iter((folder / "two").iterdir())).read_text()


def test_simulated_and_recorded_devices_ask_nothing(tmp_path: Path, addresses: dict[str, str]) -> None:
    simulated = {name: f"sim://cframe/{name}" for name in addresses}
    plan = load_campaign(real_bench.write(tmp_path, simulated))
    assert to_release(plan, plan.tests) == []
    plan = load_campaign(real_bench.write(tmp_path, simulated | {"laser": "replay://laser.rec"}))
    assert to_release(plan, plan.tests) == []
    for name in addresses:
        plan = load_campaign(real_bench.write(tmp_path, simulated | {name: addresses[name]}))
        assert len(to_release(plan, plan.tests)) == 1


@pytest.mark.parametrize(
    ("address", "simulated"),
    [
        ('address = "sim://cframe"', True),
        ('addresses = { Y1 = "sim://a", Y2 = "sim://b", X1 = "sim://c", X2 = "sim://d", Z = "sim://e" }', True),
        ('addresses = { Y1 = "sim://a", Y2 = "sim://b", X1 = "tcp://h:1", X2 = "sim://d", Z = "sim://e" }', False),
        ('address = "tcp://h:1?Y2=2&X1=3&X2=4&Z=5"', False),
    ],
)
def test_every_address_of_an_instrument_counts(tmp_path: Path, address: str, simulated: bool) -> None:
    bench = tmp_path / "bench.toml"
    head = 'schema = "errormotion.bench/1"\nname = "Frame"\nmachine = "Mill"\n'
    bench.write_text(f'{head}[instruments.frame]\ndriver = "five_sensor_frame"\n{address}\n')
    assert is_simulated(load_bench(bench)) is simulated
    output = '[compensator]\ndriver = "offset_file"\naddress = "offset.json"\n'
    bench.write_text(bench.read_text() + output)
    assert not is_simulated(load_bench(bench))


@pytest.mark.usefixtures("lab")
def test_a_campaign_without_motion_asks_nothing_at_a_real_address(write: Callable[..., Path]) -> None:
    campaign = write('name = "a"')
    bench = campaign.parent / "bench.toml"
    bench.write_text(bench.read_text().replace("sim://counter", "tcp://192.0.2.1:7"))
    (folder,) = runner.run(load_campaign(campaign))
    assert folder.finished
