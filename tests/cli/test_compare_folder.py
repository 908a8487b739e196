"""``errormotion compare`` with the folder of runs of a demonstration: what can be compared of it, and what to type."""

import numpy as np
import pytest
from typer.testing import CliRunner

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.cli.app import app

T = np.arange(0.0, 3601.0, 300.0)


def result(name, component, rng, *, known="EX EY EZ EA EB", **more):
    """Return a result over time, or of beams."""
    u = np.where(np.isin(datasets.DOF, known.split()), 1e-7, np.nan)
    dims, coords = (("beam",), {"beam": list("abcdefghijklm")}) if component == "beam" else (("time",), {"time": T})
    drift = np.multiply.outer(1 - np.exp(-T / 1500), [1e-5, 2e-5, 4e-5, 3e-5, 2e-5, 1e-5])
    return datasets.build_errors(
        drift + u * rng.normal(size=(T.size, 6)), np.tile(np.diag(u**2), (T.size, 1, 1)), dims=dims, coords=coords,
        component=component, machine="M", frame="machine", functional_point=(0, 0, 0), reference="cold", method=name,
        method_version="1", provenance={}, start="2026-03-01T08:00:00+00:00", **more,
    )  # fmt: skip


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Run folders of beams, of a bar, and of a probing on a machine whose table moves, as a demonstration writes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    rng = np.random.default_rng(1)
    for name, component, more in (
        ("beams", "beam", {}),
        ("drift", "spindle", {}),
        ("balls", "tool", {"lever_axes": "Z"}),
    ):
        made = RunFolder.create(tmp_path / "runs", "test", "1", {"test": name})
        folder = tmp_path / "runs" / name
        made.path.rename(folder)
        (folder / "errors").mkdir()
        datasets.save(result(name, component, rng, **more), folder / "errors" / "errors.nc")
        RunFolder.open(folder).save(errors="errors/errors.nc")


def call(*arguments):
    return CliRunner().invoke(app, ["compare", *arguments])


def test_a_folder_with_other_parts_and_bodies_is_compared_with_a_note_on_each(runs):
    found = call("runs")
    assert found.exit_code == 0, found.output
    assert "The 2 datasets agree within their uncertainties" in found.stdout
    assert "omitted: 'beams', whose component 'beam' differs from that of the others." in found.stdout
    assert "only displacements are compared" in found.stdout


def test_named_runs_that_do_not_fit_are_refused_with_the_command_to_type(runs):
    refused = call("runs/beams", "runs/drift", "runs/balls")
    assert refused.exit_code == 1
    assert "'beams': beam; 'drift': spindle; 'balls': tool" in refused.stderr.replace("\n", " ")
    assert "errormotion compare runs/balls runs/drift" in refused.stderr or (
        "errormotion compare runs/drift runs/balls" in refused.stderr
    )
    again = call("runs/drift", "runs/balls")
    assert "--freedoms EX,EY,EZ" in again.stderr
    assert call("runs/drift", "runs/balls", "--freedoms", "EX,EY,EZ").exit_code == 0


def test_a_stated_freedom_of_different_bodies_is_refused_also_in_a_folder(runs):
    refused = call("runs", "--freedoms", "EA")
    assert refused.exit_code == 1
    assert "different bodies" in refused.stderr
