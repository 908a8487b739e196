"""Errors of many runs do not depend on where they are identified; a failure affects one run only."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from coded import raises
from distributed import LocalCluster
from ending import end

from errormotion import datasets, parallel, plugins
from errormotion.campaign import batch, runner
from errormotion.campaign.batch import Outcome, identify_runs
from errormotion.campaign.files import CampaignPlan
from errormotion.errors import PluginError, RunError
from errormotion.methods.spindle_drift import simulation
from errormotion.plugins import PluginSettings
from errormotion.twin import Event, VirtualMachine

Identify = Callable[..., list[Outcome]]
COUNT = 3


def settings(average: float = 2.0) -> PluginSettings:
    made: PluginSettings = plugins.get("methods", "spindle_drift").Settings(average=average)
    return made


@pytest.fixture(scope="module")
def raws(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three records of a minute, and an incomplete one between them."""
    folder = tmp_path_factory.mktemp("raw")
    machine = VirtualMachine("cframe", seed=1)
    machine.start([Event(0.0, 15000.0, None)])
    t = np.arange(0.25, 60.0, 0.5)
    good = [datasets.save(simulation.raw_drift(machine, t, seed=k), folder / f"run{k}.nc") for k in range(COUNT)]
    cut = folder / "cut.nc"
    cut.write_bytes(good[0].read_bytes()[:5000])
    return [*good[:2], cut, *good[2:]]


@pytest.fixture
def identify(raws: list[Path], tmp_path: Path) -> Identify:
    """Identify the records, in sequence unless stated otherwise."""

    def call(chosen: list[Path] | None = None, **keywords: object) -> list[Outcome]:
        options: dict[str, object] = {"scheduler": "sync"} | keywords
        return identify_runs(chosen or raws, "spindle_drift", settings(), tmp_path / "out", **options)  # type: ignore[arg-type]

    return call


def local_cluster(workers: int) -> LocalCluster:
    """A scheduler at a tcp:// address and its worker processes; ports as they are free, no dashboard."""
    return LocalCluster(  # type: ignore[no-untyped-call]
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        scheduler_kwargs={"dashboard": False},
    )


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    """A cluster of one worker, in a process of its own."""
    with local_cluster(1) as made:
        yield made


@pytest.fixture(scope="module")
def reference(raws: list[Path], tmp_path_factory: pytest.TempPathFactory) -> list[Outcome]:
    """The records identified in sequence."""
    return identify_runs(raws, "spindle_drift", settings(), tmp_path_factory.mktemp("sync"), scheduler="sync")


def same_as(reference: list[Outcome], outcomes: list[Outcome]) -> None:
    """Every error dataset is identical, and only the incomplete record failed."""
    assert [outcome.raw for outcome in outcomes] == [outcome.raw for outcome in reference]
    assert [bool(outcome.reason) for outcome in outcomes] == [False, False, True, False]
    assert "truncated" in outcomes[2].reason
    assert outcomes[2].errors is None
    for outcome, wanted in zip(outcomes, reference, strict=True):
        if outcome.errors and wanted.errors:
            assert datasets.load(outcome.errors).identical(datasets.load(wanted.errors))
            assert outcome.seconds > 0


def test_a_batch_returns_the_results_of_the_method(reference: list[Outcome], raws: list[Path]) -> None:
    with datasets.load(raws[0]) as raw:
        direct = plugins.get("methods", "spindle_drift")().identify(raw, settings())
    assert reference[0].errors is not None
    errors = datasets.load(reference[0].errors)
    errors.attrs.pop(batch.MARK)
    for name in direct.variables:
        np.testing.assert_array_equal(errors[name].values, direct[name].values)
    assert errors.attrs["provenance"] == direct.attrs["provenance"]


@pytest.mark.slow
@pytest.mark.parametrize(("scheduler", "workers"), [("threads", 2), ("processes", 1)])
def test_threads_and_processes_return_identical_results(
    reference: list[Outcome], identify: Identify, scheduler: str, workers: int
) -> None:
    same_as(reference, identify(scheduler=scheduler, workers=workers))


def test_a_cluster_returns_identical_results(
    reference: list[Outcome], identify: Identify, cluster: LocalCluster
) -> None:
    address = str(cluster.scheduler_address)
    assert address.startswith("tcp://")
    same_as(reference, identify(scheduler=address))
    assert all(outcome.stepped_over for outcome in identify(scheduler=address) if not outcome.reason)


def test_cluster_with_another_version_is_refused(
    identify: Identify, cluster: LocalCluster, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(batch, "__version__", "99.0")
    with raises("scheduler.version.differs"):
        identify(scheduler=str(cluster.scheduler_address))
    assert list((tmp_path / "out").iterdir()) == []


def test_a_later_worker_with_another_version_rejects_its_task(
    identify: Identify, cluster: LocalCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch, "__version__", "99.0")
    monkeypatch.setattr(parallel, "_check_workers", lambda *_: None)
    outcomes = identify(scheduler=str(cluster.scheduler_address))
    assert all("expected errormotion in version 99.0" in outcome.reason for outcome in outcomes)


def test_a_missing_cluster_is_reported(identify: Identify, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "CLUSTER_TIMEOUT", 0.3)
    with raises("scheduler.no_answer"):
        identify(scheduler="tcp://127.0.0.1:9")


def test_cluster_without_workers_is_reported(identify: Identify, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "CLUSTER_TIMEOUT", 2.0)
    with (
        local_cluster(0) as empty,
        raises("scheduler.no_workers"),
    ):
        identify(scheduler=str(empty.scheduler_address))


def test_an_interrupted_test_continues(raws: list[Path], identify: Identify, tmp_path: Path) -> None:
    class Impatient(runner.Quiet):
        def advance(self, done: float) -> None:
            if done == 2:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="2 of 4 runs are done; repeat the command"):
        identify(progress=Impatient())
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()}
    assert sorted(path.name for path in before) == ["run0.nc", "run1.nc"]
    outcomes = identify()
    assert [outcome.stepped_over for outcome in outcomes] == [True, True, False, False]
    assert all(path.stat().st_mtime_ns == then for path, then in before.items())


def test_a_result_of_an_earlier_version_is_recognised_by_its_hash(
    raws: list[Path], identify: Identify, tmp_path: Path
) -> None:
    (outcome,) = identify(raws[:1])
    errors = datasets.load(outcome.errors)
    with datasets.load(raws[0]) as raw:
        mark = json.loads(errors.attrs[batch.MARK]) | {"raw": datasets.hash_dataset(raw, "sha256")}
    datasets.save(errors.assign_attrs({batch.MARK: json.dumps(mark)}), outcome.errors, overwrite=True)
    assert [each.stepped_over for each in identify(raws[:1])] == [True]


def test_another_result_is_never_overwritten(raws: list[Path], identify: Identify, tmp_path: Path) -> None:
    (first,) = identify(raws[:1])
    assert first.errors is not None
    before = first.errors.read_bytes()
    (other,) = identify_runs(raws[:1], "spindle_drift", settings(4.0), tmp_path / "out", scheduler="sync")
    assert "never overwritten" in other.reason
    (tmp_path / "other").mkdir()
    changed = tmp_path / "other" / "run0.nc"
    changed.write_bytes(raws[1].read_bytes())
    (other,) = identify([changed])
    assert "never overwritten" in other.reason
    assert first.errors.read_bytes() == before


def test_a_plugin_error_in_one_run_does_not_affect_others(
    raws: list[Path], identify: Identify, monkeypatch: pytest.MonkeyPatch
) -> None:
    method = plugins.get("methods", "spindle_drift")
    whole = method.identify
    noise = []

    def broken(self: object, raw: object, chosen: object) -> object:
        noise.append(raw)
        if len(noise) == 2:
            raise KeyError("oops")
        return whole(self, raw, chosen)

    monkeypatch.setattr(method, "identify", broken)
    outcomes = identify([raws[0], raws[1], raws[3]])
    assert [outcome.reason for outcome in outcomes] == ["", "KeyError: 'oops'", ""]
    assert "Traceback" in outcomes[1].traceback


def test_a_process_that_ends_unexpectedly_is_reported(
    raws: list[Path], identify: Identify, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batch, "_identify", end)
    for outcome in identify(raws[:2], scheduler="processes", workers=1):
        assert "the process ended unexpectedly" in outcome.reason


def test_names_distinguish_runs(tmp_path: Path) -> None:
    for folder in ("a/x", "b/x", "c"):
        (tmp_path / folder).mkdir(parents=True)
    raws = [tmp_path / "a/x/raw.nc", tmp_path / "b/x/raw.nc", tmp_path / "c/raw.nc", tmp_path / "c/other.nc"]
    assert batch._names(raws) == ["a-x-raw", "b-x-raw", "c-raw", "other"]
    with pytest.raises(RunError, match=r"both results would be named .*raw\.nc"):
        batch._names([tmp_path / "c/raw.nc", tmp_path / "c/raw.zarr"])


def test_a_run_stated_twice_is_identified_once(raws: list[Path], identify: Identify) -> None:
    assert len(identify([raws[0], raws[0], raws[0].parent / ".." / raws[0].parent.name / raws[0].name])) == 1


def test_a_folder_of_runs_selects_those_of_the_method(plan: Callable[..., CampaignPlan], tmp_path: Path) -> None:
    first, second = runner.run(plan('name = "a"\nsettings = {count = 500}', 'name = "b"\nsettings = {count = 500}'))
    ramp = plugins.get("methods", "ramp").Settings()
    runs = first.path.parent
    second.save(acquired=False, status="interrupted")
    (runs / "torn").mkdir()
    (runs / "torn" / "run.json").write_text("{")
    outcomes = identify_runs([runs], "ramp", ramp, tmp_path / "out", scheduler="sync")
    assert [outcome.raw for outcome in outcomes] == [first.path, second.path, runs / "torn"]
    assert outcomes[0].errors == tmp_path / "out" / f"{first.path.name}.nc"
    assert outcomes[0].errors.exists()
    assert "not complete (interrupted); continue it with 'errormotion run --resume" in outcomes[1].reason
    assert "is not valid JSON" in outcomes[2].reason
    again = identify_runs([first.path, first.raw], "ramp", ramp, tmp_path / "out", scheduler="sync")
    assert [outcome.stepped_over for outcome in again] == [True]
    (runs / "torn" / "run.json").unlink()
    with raises("batch.method.other"):
        identify_runs([runs], "spindle_drift", settings(), tmp_path / "none", scheduler="sync")


def test_errors_are_reported_before_any_action(raws: list[Path], identify: Identify, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="found 'thread'"):
        identify(scheduler="thread")
    with raises("scheduler.workers.count"):
        identify(scheduler="threads", workers=0)
    with raises("scheduler.workers.count"):
        identify(scheduler="tcp://127.0.0.1:9", workers=2)
    with raises("batch.no_datasets"):
        identify_runs([], "spindle_drift", settings(), tmp_path, scheduler="sync")
    with pytest.raises(PluginError, match="Did you mean 'spindle_drift'"):
        identify_runs(raws, "spindel_drift", settings(), tmp_path, scheduler="sync")
    (tmp_path / "out").write_text("a file")
    with raises("folder.not_created"):
        identify()


def test_a_cluster_without_dask_says_what_to_install(identify: Identify, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(RunError, match=r"'distributed', which is not installed: pip install 'errormotion\[cluster\]'"):
        identify(scheduler="tcp://127.0.0.1:9")


@pytest.mark.parametrize("scheduler", ["threads", "processes"])
def test_this_computer_requires_no_dask(raws: list[Path], tmp_path: Path, scheduler: str) -> None:
    script = (
        "import sys\n"
        "from importlib.machinery import PathFinder\n"
        "found = PathFinder.find_spec\n"
        "PathFinder.find_spec = lambda name, *rest: None if name in ('dask', 'distributed') else found(name, *rest)\n"
        "from errormotion.cli import main\n"
        f"main(['identify', {str(raws[0])!r}, {str(raws[1])!r}, '--method', 'spindle_drift', "
        f"'--out', {str(tmp_path / 'out')!r}, '--scheduler', {scheduler!r}])"
    )
    state = os.environ | {"XDG_STATE_HOME": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False, env=state)
    assert "2 identified, 0 existed already, 0 failed" in done.stdout, done.stderr


@pytest.mark.slow
def test_threads_take_turns_where_numba_is_not_safe(raws: list[Path], tmp_path: Path) -> None:
    """With its 'workqueue' layer numba ends the process when two threads call a parallel kernel at once."""
    command = ["identify", *map(str, raws[:3]), "--method", "spindle_drift", "--out", str(tmp_path / "out")]
    done = subprocess.run(
        [sys.executable, "-m", "errormotion", *command, "--scheduler", "threads", "--workers", "3"],
        env=os.environ | {"NUMBA_THREADING_LAYER": "workqueue", "XDG_STATE_HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "one run at a time" in done.stderr
    assert "2 identified, 0 existed already, 1 failed" in done.stdout
    assert f"failed: {raws[2]}: is truncated" in done.stdout
    assert done.returncode == 1
