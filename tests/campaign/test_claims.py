"""One device serves one program: a second one is refused and told who uses it; a display closes its instruments."""

import errno
import os
import platform
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import real_bench
from coded import raises

from errormotion.campaign import claims, runner
from errormotion.campaign.addresses import same_device
from errormotion.campaign.background import processes
from errormotion.campaign.background.other_processes import runs_of_other_processes
from errormotion.campaign.background.recorded import recorded
from errormotion.campaign.claims import Claim, Use, claimed, holder, use_of, uses, watching
from errormotion.campaign.files import BenchPlan, CampaignPlan, load_campaign, parse_bench
from errormotion.campaign.folder import list_runs
from errormotion.campaign.planning.release import released
from errormotion.errors import RunError

pytestmark = pytest.mark.usefixtures("lab")

MILL = (use_of("tcp://192.0.2.7:502"),)
OTHER = (use_of("tcp://192.0.2.8:502"),)
HOLDING = """
import sys
from errormotion.campaign.claims import claimed, use_of
with claimed([use_of(sys.argv[1])], "a run"):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder of claims of this test only."""
    monkeypatch.setattr(claims, "FOLDERS", (str(tmp_path / "first"), str(tmp_path / "second")))
    return tmp_path / "first"


@pytest.fixture(scope="module")
def addresses() -> Iterator[dict[str, str]]:
    with real_bench.devices() as found:
        yield found


def bench(text: str, machine: str = "Mill") -> BenchPlan:
    return parse_bench(f'schema = "errormotion.bench/1"\nname = "B"\nmachine = "{machine}"\n{text}', Path("bench.toml"))


def thermometer(url: str, machine: str = "Mill") -> BenchPlan:
    return bench(f'[instruments.t]\ndriver = "modbus_temperature"\naddress = "{url}"\nchannels = ["a"]\n', machine)


def command(folder: Path, *arguments: str, state: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "errormotion", *arguments],
        cwd=folder,
        env=os.environ | {"XDG_STATE_HOME": str(folder / state)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


# ---------------------------------------------------------------------- the same device


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("tcp://Mill.Example:5000", "tcp://mill.example:5000"),
        ("tcp://mill.example.:5000", "tcp://mill.example:5000?timeout=3"),
        ("modbus+tcp://plc", "tcp://plc:502"),
        ("modbus+tcp://plc:502?unit=1", "modbus+tcp://plc"),
        ("modbus+tcp://plc?unit=2&framing=tcp", "modbus+tcp://plc:502?framing=tcp&unit=02"),
        ("opc.tcp://cnc", "opc.tcp://CNC:4840/path"),
        ("http://agent/mill", "http://agent:80/mill?interval=5"),
        ("tcp://localhost:7", "tcp://127.0.0.1:7"),
        ("tcp://[::1]:7", "tcp://LOCALHOST:7"),
        ("tcp://[0:0:0:0:0:0:0:1]:7", "tcp://127.0.0.1:7"),
        ("tcp://[::ffff:192.0.2.1]:7", "tcp://192.0.2.1:7"),
        ("modbus+tcp://10.1", "tcp://10.0.0.1:502"),
        ("tcp://0xC0.0.2.1:7", "tcp://192.0.2.1.:7"),
        ("tcp://3221225985:7", "tcp://192.0.2.1:7"),
        ("tcp://192.0.02.01:7", "tcp://192.0.2.1:7"),
        ("tcp://127.1:7", "tcp://localhost:7"),
        (f"tcp://{platform.node().upper()}:7", "tcp://localhost:7"),
        ("tcp://[2001:DB8:0::1]:7", "tcp://[2001:db8::1]:7"),
        ("serial:///dev/ttyX?baudrate=9600", "modbus+rtu:///dev/ttyX?unit=3"),
        ("can://socketcan/can0?node=5&bitrate=1", "can://socketcan/can0?bitrate=1&node=5"),
        ("unix:///tmp/../tmp/a.sock", "unix:///tmp/a.sock"),
        ("file:///tmp/offset.json", "/tmp/./offset.json"),
    ],
)
def test_addresses_of_one_device_are_the_same(one: str, other: str) -> None:
    assert same_device(one) == same_device(other) != ""


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("tcp://plc:502", "tcp://plc:503"),
        ("modbus+tcp://plc?unit=1", "modbus+tcp://plc?unit=2"),
        ("http://agent:5000/a", "http://agent:5000/b"),
        ("can://socketcan/can0?node=5", "can://socketcan/can0?node=6"),
        ("tcp://127.0.0.2:7", "tcp://127.0.0.1:7"),
        ("serial:///dev/ttyX", "serial:///dev/ttyY"),
    ],
)
def test_addresses_of_different_devices_differ(one: str, other: str) -> None:
    assert same_device(one) != same_device(other)


def test_a_link_to_a_serial_line_is_the_line(tmp_path: Path) -> None:
    (tmp_path / "ttyUSB0").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB0")
    assert same_device(f"serial://{tmp_path}/by-id?baudrate=9600") == same_device(f"serial://{tmp_path}/ttyUSB0")


# ---------------------------------------------------------------------- claims


@pytest.mark.usefixtures("shared")
def test_a_second_program_is_refused_and_told_the_holder(tmp_path: Path) -> None:
    with claimed(uses(thermometer("tcp://plc:502")), "a run") as held:
        held.records(tmp_path)
        with (
            pytest.raises(RunError) as refused,
            claimed(uses(thermometer("modbus+tcp://PLC?unit=1", machine="renamed")), "a monitor"),
        ):
            pass
        for part in ("t (modbus+tcp://PLC?unit=1)", "a run", f"process {os.getpid()}", "since 20", str(tmp_path)):
            assert part in str(refused.value)
        with claimed(uses(thermometer("tcp://other:502")), "a run"):  # another device of a machine with this name
            pass
    with claimed(uses(thermometer("tcp://plc:502")), "a run"):
        pass


@pytest.mark.usefixtures("shared")
@pytest.mark.parametrize("url", ["sim://cframe/t", "replay://t.rec"])
def test_simulated_and_recorded_devices_serve_any_number_of_programs(url: str) -> None:
    wanted = uses(thermometer(url))
    with claimed(wanted, "a run"), claimed(wanted, "another run"):
        assert holder(wanted) == Claim("another run")  # yet it is visible for displays of this user


@pytest.mark.usefixtures("shared")
def test_a_compensation_goes_beside_a_measurement_that_shows_its_effect_except_on_a_serial_line() -> None:
    plan = bench(
        '[instruments.t]\ndriver = "modbus_temperature"\naddress = "tcp://logger:502"\nchannels = ["a"]\n'
        '[compensator]\ndriver = "offset_file"\naddress = "/tmp/offset.json"\n'
    )
    armed, shadow = uses(plan, "follow", offsets=True), uses(plan, "follow")
    with (
        claimed(armed, "armed"),
        claimed(shadow, "shadow"),
        claimed(uses(plan), "a run"),
        pytest.raises(RunError, match=r"the offset output \(/tmp/offset.json\) is in use"),
        claimed(armed, "again"),
    ):
        pass
    line = thermometer("modbus+rtu:///dev/ttyX")
    with claimed(uses(line, "follow"), "shadow"), pytest.raises(RunError), claimed(uses(line), "a run"):
        pass


def test_a_claim_ends_with_its_process_and_holds_for_another_state_folder(tmp_path: Path, addresses: dict) -> None:
    url = addresses["control"]
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDING, url],
        env=os.environ | {"XDG_STATE_HOME": str(tmp_path / "other")},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        with (
            pytest.raises(RunError, match=f"a run of user .*, process {process.pid}, since"),
            claimed([use_of(url)], "x"),
        ):
            pass
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    with claimed([use_of(url)], "x"):
        assert holder([use_of(url)]) == Claim("x")


@pytest.mark.usefixtures("shared")
def test_of_many_programs_that_start_at_once_one_is_admitted() -> None:
    begin, admitted, refused = threading.Barrier(8), [], []

    def work() -> None:
        begin.wait()
        try:
            with claimed(MILL, "a run"):
                admitted.append(1)
                done.wait(30)
        except RunError:
            refused.append(1)
        if len(refused) == 7:
            done.set()

    done = threading.Event()
    threads = [threading.Thread(target=work) for _ in range(8)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert (len(admitted), len(refused)) == (1, 7)


# ---------------------------------------------------------------------- the folder


def test_the_folder_is_for_every_user_whatever_the_mask(shared: Path) -> None:
    mask = os.umask(0o077)
    try:
        with claimed(MILL, "a run"):
            assert stat.S_IMODE(shared.stat().st_mode) == 0o1777
            assert {stat.S_IMODE(path.stat().st_mode) for path in shared.iterdir()} == {0o644}
    finally:
        os.umask(mask)
    assert [path.name for path in shared.iterdir()] == ["lock"]


def test_a_folder_that_not_everybody_can_use_is_replaced_with_a_note(shared: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    shared.symlink_to(elsewhere)  # of somebody who wants to see the claims
    with claimed(MILL, "a run") as held:
        assert held.note == f"{shared} cannot be used; the claims of the instruments are in {tmp_path / 'second'}."
        with pytest.raises(RunError), claimed(MILL, "another"):
            pass
    assert list(elsewhere.iterdir()) == []
    (tmp_path / "second" / "lock").unlink()
    (tmp_path / "second").rmdir()
    (tmp_path / "second").mkdir(0o755)
    with claimed(MILL, "a run") as held:
        assert "Programs of other users do not see them" in held.note
        with pytest.raises(RunError), claimed(MILL, "another"):
            pass


def test_without_any_folder_a_run_is_not_prevented(
    shared: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(claims, "FOLDERS", (str(tmp_path / "file"),))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "file"))
    with claimed(MILL, "a run") as held:
        held.records(tmp_path)
        assert "is not known" in held.note
        with watching(MILL) as free:
            assert free


def test_foreign_files_in_the_folder_disturb_no_claim(shared: Path, tmp_path: Path) -> None:
    with claimed(MILL, "a run"):
        pass
    secret = tmp_path / "secret"
    secret.write_text("text")
    (shared / "a.claim").symlink_to(secret)
    (shared / "b.claim").mkdir()
    os.mkfifo(shared / "c.claim")
    (shared / "d.claim").write_text("{" * 100)
    with (shared / "e.claim").open("w") as file:
        file.write('{"keys": [], "what": 1}')
        file.flush()
        claims.fcntl.flock(file, claims.fcntl.LOCK_EX)
        with claimed(MILL, "a run"), pytest.raises(RunError, match="a run of user"), claimed(MILL, "another"):
            pass
    assert secret.read_text() == "text"
    assert not (shared / "d.claim").exists()  # of no living process


# ---------------------------------------------------------------------- displays


@pytest.mark.usefixtures("shared")
def test_a_claim_waits_until_displays_have_released_the_instruments_and_expires(shared: Path) -> None:
    left, end = [], threading.Event()

    def watch() -> None:
        with watching(MILL) as free:
            assert free
            begun.set()
            while holder(MILL) is None and not end.is_set():
                time.sleep(0.01)
            left.append(True)

    begun = threading.Event()
    thread = threading.Thread(target=watch)
    thread.start()
    assert begun.wait(30)
    try:
        with claimed(MILL, "a run"):
            assert left == [True]
            with watching(MILL) as free:
                assert not free
            assert holder(OTHER) is None
    finally:
        end.set()
        thread.join()
    assert holder(MILL) is None
    assert [path.name for path in shared.iterdir()] == ["lock"]


@pytest.mark.usefixtures("shared")
def test_a_display_that_does_not_release_its_instruments_does_not_prevent_a_measurement(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(claims, "RELEASE_TIMEOUT", 0.1)
    with watching(MILL), claimed(MILL, "a run"):
        assert holder(MILL) == Claim("a run")


def test_a_run_claims_its_bench_and_is_visible_to_other_processes(
    plan: Callable[..., CampaignPlan], tmp_path: Path
) -> None:
    campaign, seen = plan('name = "a"\n[test.settings]\ncount = 3000'), []
    wanted = uses(campaign.bench)

    class Looking(runner.Quiet):
        def advance(self, done: float) -> None:
            seen.append((holder(wanted), runs_of_other_processes(tmp_path / "runs", ())))

    (folder,) = runner.run(campaign, progress=Looking())
    claim, (found,) = seen[-1]
    assert claim == Claim("a run", folder.path)
    assert (found.campaign, found.test, found.stage, found.tests) == (
        "Ramps",
        "a",
        "measuring",
        {"a": folder.path.name},
    )
    assert found.expected > 0
    assert (holder(wanted), runs_of_other_processes(tmp_path / "runs", ())) == (None, [])
    record = recorded(folder.path)
    assert (record.title, record.samples) == ("a of Ramps", folder.data["samples"]["count"])
    assert record.values
    with folder.locked():  # a finished run whose report is made again is not measuring
        assert runs_of_other_processes(tmp_path / "runs", ()) == []


# ---------------------------------------------------------------------- commands


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ("run", "campaign.toml", "--move"),
        ("run", "campaign.toml", "--move", "--detach"),
        ("monitor", "bench.toml", "--duration", "1 s"),
        ("record", "bench.toml", "laser", "--for", "1 s"),
        ("bench", "probe", "bench.toml"),
        ("plugins", "check", "attocube_ids", "--address", "{laser}"),
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_a_command_of_another_user_is_refused_while_a_bench_is_in_use(
    tmp_path: Path, addresses: dict[str, str], arguments: tuple[str, ...]
) -> None:
    real_bench.write(tmp_path, addresses, machine="Mill 7")
    laser = addresses["laser"].replace("127.0.0.1", "localhost")
    real_bench.write(tmp_path / "theirs", addresses | {"laser": laser}, machine="Renamed")
    plan = load_campaign(tmp_path / "campaign.toml")
    with claimed(uses(plan.bench), "a run"):
        refused = command(tmp_path / "theirs", *(each.format(laser=laser) for each in arguments), state="state")
        _, error = refused.communicate(timeout=120)
    assert refused.returncode == 1, error
    assert f"({laser}) is in use by another program: a run of user " in error or f"{laser} is in use" in error
    assert f"process {os.getpid()}, since" in error
    assert not (tmp_path / "theirs" / "runs").exists()


def test_the_second_of_two_runs_on_one_bench_creates_nothing(tmp_path: Path, addresses: dict[str, str]) -> None:
    plan = load_campaign(real_bench.write(tmp_path, addresses))
    refused: list[str] = []

    class Second(runner.Quiet):
        def advance(self, done: float) -> None:
            with pytest.raises(RunError) as found:
                runner.run(plan, runs=tmp_path / "second", release=released)
            refused.append(str(found.value))
            with raises("claim.instrument.used"):
                processes.start(plan.source, tmp_path / "third", released)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        runner.run(plan, runs=tmp_path / "first", release=released, progress=Second())
    (folder,) = list_runs(tmp_path / "first")
    assert "laser" in refused[0]
    assert str(folder.path) in refused[0]
    assert not (tmp_path / "second").exists()
    assert not (tmp_path / "third" / ".background").exists()


def test_a_folder_that_is_no_record_is_reported(tmp_path: Path) -> None:
    with pytest.raises(RunError):
        recorded(tmp_path)


def test_the_hash_of_an_address_does_not_disclose_it() -> None:
    (found,) = uses(thermometer("tcp://secret.example:502"))
    assert isinstance(found, Use)
    assert "secret" not in found.key


@pytest.mark.parametrize("places", [1, 2])
def test_a_folder_whose_files_cannot_be_locked_is_replaced_with_a_note(
    shared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, places: int
) -> None:
    """Some network file systems refuse locks."""
    refused = [tmp_path / "first", tmp_path / "second"][:places]
    real = claims.fcntl.flock

    def flock(descriptor: int, how: int) -> None:
        if Path(os.readlink(f"/proc/self/fd/{descriptor}")).parent in refused:
            raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
        real(descriptor, how)

    monkeypatch.setattr(claims.fcntl, "flock", flock)
    claims._locks.cache_clear()
    with claimed(MILL, "a run") as held:
        assert "cannot be used" in held.note or "can be used by every user" in held.note
        found = holder(MILL)
        assert found is not None
        assert found.what == "a run"
        with raises("claim.instrument.used"), claimed(MILL, "a second run"):
            pass
    refused.append(claims.state_folder() / "claims")
    refused += [tmp_path / "first", tmp_path / "second"]
    claims._locks.cache_clear()
    with claimed(MILL, "a run") as held, claimed(MILL, "a second run"):
        assert "No file can be locked" in held.note
        assert "start no second one" in held.note
    assert holder(MILL) is None
    with watching(MILL) as free:
        assert free
    claims._locks.cache_clear()
