"""A quick form of ``make faults``: real processes with one example; kills, disks that fail, and a clock that is set."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import fault_compensation
import fault_processes
import fault_trials as trials
import pytest
from fault_kinds import Kinds

from errormotion.campaign import runner
from errormotion.campaign.folder import list_runs

EXAMPLE = Path(__file__).parents[2] / "examples" / "virtual_beam" / "campaign.toml"
METHOD, TEST = "beam_direction", "beam"
LIMIT = 8_000
"""Of the size of a file: enough for run.json at the start, not for the whole run, bytes."""


@pytest.fixture(scope="module")
def kinds(tmp_path_factory: pytest.TempPathFactory) -> Kinds:
    folder = tmp_path_factory.mktemp("faults")
    library = fault_processes.shim(folder)
    fault_processes.prepare(library)
    found = Kinds(folder, seed=3, shimmed=library is not None, methods=(METHOD,))
    found.undisturbed(METHOD)
    return found


@pytest.fixture
def undisturbed(kinds: Kinds) -> Path:
    return kinds.folder / "undisturbed" / METHOD


@pytest.mark.timeout(120)
@pytest.mark.parametrize("kind", ["kill_acquisition", "kill_later", "disk", "clock_between"])
def test_run_survives(kinds: Kinds, kind: str) -> None:
    if kind in ("disk", "clock_between") and not kinds.shimmed:
        pytest.skip("no C compiler makes disk and clocks fail")
    for number in range(4):  # a busy computer may kill a run only after its end, when there is nothing to resume
        result = getattr(kinds, kind)(number)
        assert result.faults == []
        if result.different is not None:
            break
    assert result.different == []


@pytest.mark.timeout(120)
def test_a_killed_compensation_has_said_what_it_wrote_and_starts_again_without_a_jump(kinds: Kinds) -> None:
    assert kinds.kill_compensation(0).faults == []


def test_jumps_and_orders_that_are_not_in_the_audit_log_are_found(tmp_path: Path) -> None:
    steps = [(k * 1e-6, 0.0, 0.0) for k in range(4)]
    assert fault_compensation._course(steps, steps[0]) == []
    assert len(fault_compensation._course([steps[3]], steps[0])) == 1
    assert len(fault_compensation._course([(0.0, 30e-6, 0.0)], (0.0, 29e-6, 0.0))) == 1
    assert len(fault_compensation._audited(tmp_path, steps)) == len(steps)


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_run_on_a_full_disk_ends_with_a_sentence_and_finishes_with_space(tmp_path: Path, undisturbed: Path) -> None:
    log = tmp_path / "errormotion" / "errormotion.log"  # of the commands: the same disk is full for it
    log.parent.mkdir()
    log.write_bytes(b"\n" * LIMIT)
    words, state = ["run", EXAMPLE, "--runs", tmp_path / "runs"], {"XDG_STATE_HOME": str(tmp_path)}
    ended = trials.finish(fault_processes.Forked(words, tmp_path / "journal", LIMIT, environment=state))
    assert ended.faults == []
    assert ended.code not in (0, trials.INTERNAL_ERROR)
    assert os.strerror(errno.EFBIG) in ended.message
    assert trials.half_files(tmp_path / "runs") == []
    (folder,) = runner.resume(runs=tmp_path / "runs")
    assert folder.finished
    assert trials.differences(tmp_path / "runs", undisturbed) == []


def test_half_files_and_lost_samples_are_found(tmp_path: Path, undisturbed: Path) -> None:
    (folder,) = list_runs(undisturbed)
    assert folder.errors is not None
    half = tmp_path / "run" / "errors.nc"
    half.parent.mkdir()
    half.write_bytes(folder.errors.read_bytes()[:2000])
    (half.parent / "report.html").write_text("<html><body>")
    assert len(trials.half_files(tmp_path)) == 2
    assert trials.differences(tmp_path, undisturbed) == [f"{TEST}: not finished"]


@pytest.mark.timeout(120)
def test_workers_of_a_killed_process_end(tmp_path: Path) -> None:
    waiting = tmp_path / "waiting"
    script = tmp_path / "work.py"
    script.write_text(
        "import sys, time, pathlib\n"
        "from errormotion.parallel import Workers\n"
        "def wait(name):\n"
        "    pathlib.Path(name).touch()\n"
        "if __name__ == '__main__':\n"
        "    with Workers('processes', 2, '') as pool:\n"
        "        pool.run(wait, [(sys.argv[1],)], print, print)\n"
        "        time.sleep(100)\n"
    )
    process = subprocess.Popen([sys.executable, script, waiting], stdout=subprocess.DEVNULL, start_new_session=True)
    trials.kill_when(process, waiting.exists, 0.2)
    assert waiting.exists()
    assert trials.ends(process.pid)
