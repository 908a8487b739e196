"""Monte Carlo evaluation of a method: trials are independent of the executor, stored, resumed, and evaluated."""

import json
import shutil
from collections import Counter
from functools import cache

import numpy as np
import pytest
import xarray as xr
from coded import raises
from numpy.random import SeedSequence
from typer.testing import CliRunner

from errormotion import datasets, montecarlo, plugins
from errormotion.cli.app import app
from errormotion.errors import DatasetError, MethodError, RunError
from errormotion.montecarlo import evaluation, trials
from errormotion.montecarlo.places import PLACES, chosen_places
from errormotion.montecarlo.report import chapters, texts
from errormotion.montecarlo.result import SCHEMA, lines
from errormotion.montecarlo.store import Store
from errormotion.plugins import Method, MethodInfo, Needs, PluginSettings, RandomSource, TrialModel
from errormotion.report.document import Source

pytestmark = pytest.mark.usefixtures("translated")

TRIALS, FEW = 40, 8
NOISE, OFFSET = 0.5e-6, 0.9e-6  # m
TIMES = [0.0, 60.0, 120.0]


@cache
def _template() -> xr.Dataset:
    """A result of the method below without displacements."""
    values = np.full((3, 6), np.nan)
    values[:, :2] = 0.0
    covariance, influence = np.full((3, 6, 6), np.nan), np.full((1, 3, 6), np.nan)
    covariance[:, :2, :2] = NOISE**2 * np.eye(2) + OFFSET**2
    influence[0, :, :2] = OFFSET
    return datasets.build_errors(
        values, covariance, dims=("time",), coords={"time": TIMES}, component="tool", machine="none",
        frame="machine", functional_point=np.zeros(3), reference="none", method="straight", method_version="1",
        provenance={"settings": {}}, influence=influence, sources=["offset"], source_groups=["sensor"],
    )  # fmt: skip


def _shifted(raw: xr.Dataset, by) -> xr.Dataset:
    found = raw.copy(deep=True)
    found.variables["reading"].values[:] += by
    return found


class Straight(Method):
    """Displacement along X and Y at three times; readings have noise and a common offset of the sensor."""

    info = MethodInfo("straight", "A method that exists in this test only", "simulated_only")
    needs = Needs((), "errormotion.raw.straight/1")
    Settings = PluginSettings

    def identify(self, raw, settings):
        result = _template().copy(deep=True)
        for k, name in enumerate(("EX", "EY")):
            result.variables[name].values[:] = raw["reading"].values[:, k]
        return result

    def trial_model(self, raw, settings, errors):
        def noise(raw, settings, generator):
            return _shifted(raw, generator.normal(0, NOISE, raw["reading"].shape)), settings

        def offset(raw, settings, generator):
            return _shifted(raw, generator.normal(0, OFFSET)), settings

        return TrialModel(
            raw.load(), settings, {"noise": RandomSource(noise, own=True), "offset": RandomSource(offset, ("sensor",))}
        )


@pytest.fixture(scope="module", autouse=True)
def registered():
    """Let the registry know the method of this test."""
    real = plugins.get
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plugins, "get", lambda group, name: Straight if name == "straight" else real(group, name))
        yield


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory):
    """A raw dataset on disk, its method, settings and linear result."""
    reading = 1e-5 * np.arange(6.0).reshape(3, 2)
    raw = xr.Dataset({"reading": (("time", "axis"), reading, {"units": "m"})}, {"time": TIMES})
    path = datasets.save(raw.assign_attrs(schema=Straight.needs.raw_schema), tmp_path_factory.mktemp("raw") / "raw.nc")
    return path, Straight, PluginSettings(), Straight().identify(raw, PluginSettings())


@pytest.fixture(scope="module")
def found(measured, tmp_path_factory: pytest.TempPathFactory) -> xr.Dataset:
    """The evaluation, with trials in sequence."""
    return _evaluate(measured, tmp_path_factory.mktemp("sync") / "trials", scheduler="sync")


def _evaluate(measured, folder, **options):
    path, method, settings, errors = measured
    options = {"trials": TRIALS, "seed": 5} | options
    return montecarlo.evaluate(path, method.info.id, settings, errors, folder, **options)


def test_the_trials_have_the_stated_uncertainty(found):
    u, linear = (found[name].sel(dof="EX").values for name in ("uncertainty", "linear_uncertainty"))
    # a standard deviation of 40 normal values is known to 1 / sqrt(80), 11 %; four of these
    np.testing.assert_allclose(u / linear, 1.0, atol=0.45)
    assert found.attrs["schema"] == SCHEMA
    assert found.attrs["trials"] == TRIALS


def test_threads_return_identical_results_and_leave_no_trials(measured, found, tmp_path):
    again = _evaluate(measured, tmp_path / "trials", scheduler="threads", workers=3)
    assert again.identical(found)
    assert not (tmp_path / "trials").exists()


@pytest.mark.slow
def test_processes_and_a_cluster_return_identical_results(tmp_path, monkeypatch):
    from distributed import LocalCluster

    monkeypatch.setattr(evaluation, "MIN_TRIALS", FEW)
    subject = plugins.get("methods", "beam_direction").conformance()[0]
    raw, settings = subject.make(0)[0], subject.effective_settings()
    path = datasets.save(raw, tmp_path / "raw.nc")
    given = path, subject.plugin, settings, subject.identify(raw)
    found = _evaluate(given, tmp_path / "zero", scheduler="sync", trials=FEW)
    assert _evaluate(given, tmp_path / "one", scheduler="processes", workers=1, trials=FEW).identical(found)
    with LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=None
    ) as cluster:
        assert cluster.scheduler_address.startswith("tcp://")
        assert _evaluate(given, tmp_path / "two", scheduler=cluster.scheduler_address, trials=FEW).identical(found)


def test_trials_continue_until_the_tolerance_is_reached(measured, tmp_path, monkeypatch):
    """u = 1.03 um and a tolerance of 0.5 um: some hundred trials decide, and the linear model is validated."""
    monkeypatch.setattr(evaluation, "block_size", lambda probability, cheap: 60)
    found = _evaluate(measured, tmp_path / "trials", trials=None, scheduler="sync", most=3000)
    assert 120 <= found.attrs["trials"] < 3000
    assert found.attrs["trials"] % 60 == 0
    assert found["stable"].sel(dof=["EX", "EY"]).values.all()
    assert (found["verdict"].sel(dof=["EX", "EY"]) == 1).all()


def test_a_stopped_evaluation_continues_where_it_was(measured, found, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(evaluation, "CHUNK", 8)

    class StopsAfter:
        def stage(self, name, total=None): ...
        def note(self, text): ...

        def advance(self, done):
            seen.append(done)
            if done >= 3 * evaluation.CHUNK:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        _evaluate(measured, tmp_path / "trials", scheduler="sync", progress=StopsAfter())
    assert len(list((tmp_path / "trials").glob("block-*.npy"))) == 3
    computed = Counter()
    whole = evaluation.compute
    monkeypatch.setattr(evaluation, "compute", lambda *task: computed.update([task[7]]) or whole(*task))
    continued = _evaluate(measured, tmp_path / "trials", scheduler="sync")
    assert continued.identical(found)
    assert sorted(computed) == [3 * evaluation.CHUNK, 4 * evaluation.CHUNK]


def test_trials_of_another_evaluation_are_not_used(measured, tmp_path):
    with Store(tmp_path / "trials", {"seed": 1}):
        pass
    with raises("monte_carlo.folder.other"):
        _evaluate(measured, tmp_path / "trials", scheduler="sync")


def test_a_folder_of_a_started_evaluation_is_used(tmp_path):
    """Its process was killed, or the disk was full, while the key was written."""
    (tmp_path / ".evaluation.json.0123456789abcdef.part").write_text('{"se')
    with Store(tmp_path, {"seed": 1}):
        pass
    assert (tmp_path / "evaluation.json").exists()


@pytest.mark.parametrize("text", ["", "[" * 10**5, "3", " " * (2**20 + 1)])
def test_a_damaged_folder_is_reported(tmp_path, text):
    (tmp_path / "evaluation.json").write_text(text)
    with pytest.raises(RunError, match="trials"), Store(tmp_path, {"seed": 1}):
        pass


def test_damaged_trials_are_repeated(tmp_path):
    with Store(tmp_path / "trials", {"seed": 1}) as store:
        store.keep(0, range(2), np.ones((2, 3)))
        store.keep(0, range(2, 4), np.ones((2, 3)))
        file = tmp_path / "trials" / "block-0000-2-4.npy"
        file.write_bytes(file.read_bytes()[:40])
        assert store.chunks(0, 4) == [range(2)]


@pytest.mark.parametrize(
    ("options", "code"),
    [
        ({"trials": 10}, "monte_carlo.trials.count"),
        ({"digits": 3}, "monte_carlo.digits"),
        ({"scheduler": "elsewhere"}, "scheduler.unknown"),
    ],
)
def test_invalid_options_are_an_error(measured, tmp_path, options, code):
    with raises(code):
        _evaluate(measured, tmp_path / "trials", **options)


def test_a_method_without_trial_model_is_refused(measured):
    _, method, settings, errors = measured

    class Plain(Method):
        info = method.info

    with raises("monte_carlo.method.no_trial_model"):
        trials.trial_model_of(Plain(), None, settings, errors)


def test_reduced_data_with_other_values_are_a_defect(measured):
    path, method, settings, errors = measured
    raw = datasets.load(path).load()

    class Shifted(method):
        def trial_model(self, raw, settings, errors):
            scaled = raw.assign(reading=raw["reading"] + 1e-5)
            return TrialModel(scaled, settings, {})

    with raises("monte_carlo.trial_model.values"):
        trials.trial_model_of(Shifted(), raw, settings, errors)


def test_an_omitted_source_does_not_change_the_samples_of_the_others():
    def adds(raw, settings, generator):
        return [*raw, generator.normal()], settings

    class Lists(Method):
        def identify(self, raw, settings):
            return raw

    drawn = TrialModel([], None, {name: RandomSource(adds) for name in "abc"})
    whole = trials.trial(Lists(), drawn, SeedSequence(3))
    assert trials.trial(Lists(), drawn, SeedSequence(3), only=["a", "c"]) == [whole[0], whole[2]]


def test_refused_trials_are_counted_and_named(measured, tmp_path, monkeypatch):
    whole = trials.trial

    def refuses(method, trial_model, sequence, only=None):
        if sequence.spawn_key[-1] % 5 == 0:
            raise MethodError("no luck")
        return whole(method, trial_model, sequence, only)

    monkeypatch.setattr(trials, "trial", refuses)
    found = _evaluate(measured, tmp_path / "trials", scheduler="sync")
    assert int(found["missing"].max()) == TRIALS // 5
    assert any("8 trials failed: no luck" in note for note in found.attrs["notes"])
    assert {line.word for line in lines(found)} == {"undecided"}


def test_long_records_are_thinned_and_keep_their_ends():
    errors = xr.Dataset({"EX": (("time", "position"), np.zeros((3000, 7)))}, attrs={"schema": datasets.SCHEMA})
    rows, where = chosen_places(errors)
    assert len(rows) <= PLACES
    assert [where["time"][0], where["time"][-1], len(where["position"])] == [0, 2999, 7]
    assert rows[0] == 0
    assert rows[-1] == 3000 * 7 - 1


def test_a_curved_model_is_not_validated_and_a_straight_one_is():
    """y = x^2 about 0 has no linear uncertainty; y = x has the normal one."""

    def block(sequence, size):
        x = np.random.default_rng(sequence).normal(size=size)
        return np.stack([x, x**2], axis=1)

    summary = montecarlo.propagate(block, trials=200_000, digits=1)
    verdict = montecarlo.validate_linear(np.zeros(2), np.array([1.0, 1e-3]), summary).verdict
    assert verdict.tolist() == [1, 0]


def test_the_command_prints_and_stores_the_verdicts(measured, tmp_path):
    out = tmp_path / "errors.nc"
    command = ["identify", str(measured[0]), "--out", str(out), "--method", "straight", "--monte-carlo", str(TRIALS)]
    result = CliRunner().invoke(app, [*command, "--scheduler", "sync", "--json"])
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    stored = datasets.load(answer["monte_carlo"])
    assert not list(datasets.violations(stored))
    again = [str(stored["dof"].values[0])] * stored.sizes["dof"]
    for wrong in (stored.assign_coords(dof=again), stored.assign_attrs(probability="most")):
        assert len(list(datasets.violations(wrong))) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["errors.monte_carlo.nc", "errors.nc"]
    assert [verdict["freedom"] for verdict in answer["verdicts"]] == ["EX", "EY"]
    assert {verdict["verdict"] for verdict in answer["verdicts"]} <= {"validated", "not validated", "undecided"}
    page = tmp_path / "report.html"
    assert CliRunner().invoke(app, ["report", str(out), "--out", str(page)]).exit_code == 0
    assert "Monte Carlo evaluation of tool" in page.read_text(encoding="utf-8")
    repeated = CliRunner().invoke(app, command)
    assert repeated.exit_code == 1
    assert "already exists" in repeated.output


def test_several_results_are_evaluated_in_sequence_and_a_second_call_adds_nothing(measured, tmp_path):
    raws = [shutil.copy(measured[0], tmp_path / f"{name}.nc") for name in "ab"]
    command = ["identify", *map(str, raws), "--out", str(tmp_path / "out"), "--method", "straight"]
    command += ["--monte-carlo", str(TRIALS), "--scheduler", "sync"]
    result = CliRunner().invoke(app, [*command, "--json"])
    assert result.exit_code == 0, result.output
    assert [len(run["verdicts"]) for run in json.loads(result.stdout)["runs"]] == [2, 2]
    made = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()}
    assert len([path for path in made if path.name.endswith(".monte_carlo.nc")]) == 2
    assert CliRunner().invoke(app, command).exit_code == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()} == made


def test_the_number_of_trials_is_validated(measured, tmp_path):
    result = CliRunner().invoke(
        app,
        ["identify", str(measured[0]), "--out", str(tmp_path / "e.nc"), "--method", "straight", "--monte-carlo", "x"],
    )
    assert result.exit_code == 1
    assert "expected 'auto' or a number of trials; found 'x'" in result.output


def test_the_chapter_states_every_freedom(found):
    (part,) = chapters(Source(found))
    assert part.summary[0].startswith("Linear intervals: ")
    head, rows = texts(found)
    assert [row[0] for row in rows] == ["EX", "EY"]
    assert all(len(row) == len(head) for row in rows)


def test_violations_of_the_schema_are_named(found):
    broken = found.drop_vars("shortest").assign(verdict=found["verdict"] + 3)
    with pytest.raises(DatasetError, match="shortest"):
        datasets.validate(broken)
