"""Scanning the pocket on the virtual gantry."""

import json

import numpy as np
import pytest
import xarray as xr
from armed import CONTROLLER
from coded import raises
from scipy.spatial.transform import RigidTransform

from errormotion import datasets
from errormotion.errors import MethodError
from errormotion.instruments.controller.virtual import VirtualController
from errormotion.instruments.line_profiler.keyence_ljx import KeyenceLJX
from errormotion.instruments.line_profiler.profile_files import ProfileFiles
from errormotion.instruments.simulators import world
from errormotion.methods.crossbeam_scan.acquisition.pocket import record_pocket
from errormotion.methods.crossbeam_scan.identification.profiler_pose.calibration import calibrate_dataset, parameters
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings

SETTINGS = CrossbeamScanSettings(procedure="profiler_pose", pocket_position=0.1, travel=(-0.9, 0.9))


class Bench:
    machine = "a gantry"

    def __init__(self, **instruments):
        self.instruments, self.asked = instruments, []

    def has_kind(self, kind):
        return kind in self.instruments

    def of_kind(self, kind):
        return self.instruments[kind]

    def ask(self, message):
        self.asked.append(message)


def gantry(seed, parameters=""):
    """Return the instruments of a virtual gantry with a pocket on its table."""
    address = f"sim://gantry/profiler?seed={seed}&points=800&pitch=5e-5&artefacts=none&pocket=0.1{parameters}"
    return VirtualController(f"sim://gantry/controller?seed={seed}", CONTROLLER), KeyenceLJX(address)


def joined(chunks):
    """Return chunks as one dataset, the counts of what is invalid left out."""
    raw = xr.concat(
        chunks, dim="scan", data_vars="minimal", coords="minimal", compat="override", join="exact",
        combine_attrs="override",
    )  # fmt: skip
    del raw.attrs["invalid"]
    return raw


def test_identified_pose_is_the_true_one():
    control, profiler = gantry(21)
    with control, profiler:
        raw = joined(list(record_pocket(Bench(controller=control, line_profiler=profiler), SETTINGS, None)))
        true = parameters(RigidTransform.from_matrix(world("gantry", 21).machine.crossbeam.pose))
        assert world("gantry", 21).warm_time(np.array([1e6]))[0] == 0.0  # it has not warmed the machine
    datasets.validate(raw)
    assert raw["height"].shape == (2, 400, 800)
    assert list(json.loads(raw.attrs["programs"])) == ["pocket_1.nc", "pocket_2.nc"]
    found = calibrate_dataset(raw)
    off = (found.values - true) / np.sqrt(np.diag(found.covariance))
    assert np.abs(off).max() < 4.5  # one draw of six; 3e-5 of all draws are further off


def test_stage_follows_encoder_and_lift():
    control, profiler = gantry(22)
    with control, profiler:
        raw = joined(list(record_pocket(Bench(controller=control, line_profiler=profiler), SETTINGS, None)))
    y = raw["stage"].values[..., 1]
    # counts at the triggers are multiples of 70 um from the encoder's zero, the pocket is not
    np.testing.assert_allclose((y + 0.1) / 70e-6, np.rint((y + 0.1) / 70e-6), atol=1e-6)
    np.testing.assert_allclose(np.diff(y, axis=1), 70e-6, atol=1e-12)
    assert np.abs(y).max() <= 14e-3 + 70e-6
    np.testing.assert_array_equal(raw["stage"].values[..., 2], np.tile([[0.166], [0.182]], (1, 400)))


def test_recorded_lifts_are_not_scanned_again():
    control, profiler = gantry(23)
    with control, profiler:
        bench = Bench(controller=control, line_profiler=profiler)
        first = next(record_pocket(bench, SETTINGS, None))
        rest = list(record_pocket(bench, SETTINGS, first))
    assert [float(chunk["stage"][0, 0, 2]) for chunk in rest] == [0.182]


def test_profiler_that_always_fails_ends_the_test():
    control, profiler = gantry(24, "&fault=disconnect&fault_at=200")
    with control, profiler, raises("scan.program.failed"):
        list(record_pocket(Bench(controller=control, line_profiler=profiler), SETTINGS, None))


def test_lost_lines_are_nan():
    control, profiler = gantry(25, "&fault=drop&fault_at=100&fault_every=50")
    with control, profiler:
        raw = joined(list(record_pocket(Bench(controller=control, line_profiler=profiler), SETTINGS, None)))
    lost = np.isnan(raw["height"].values).all(axis=2)
    assert 4 <= lost[0].sum() <= 8  # one line in fifty of 400
    np.testing.assert_allclose(np.diff(raw["stage"].values[..., 1], axis=1), 70e-6, atol=1e-12)
    assert raw.attrs["dropped"] > 0


def test_lines_farther_apart_than_stated_are_reported():
    control, profiler = gantry(26)
    with control, profiler, pytest.raises(MethodError, match=r"Expected 700 lines 40 um apart .* found 4\d\d"):
        list(record_pocket(
            Bench(controller=control, line_profiler=profiler), SETTINGS.model_copy(update={"line_pitch": 40e-6}), None
        ))  # fmt: skip


def test_pockets_are_not_read_from_files(tmp_path):
    with raises("scan.pocket.from_files"):
        list(record_pocket(Bench(line_profiler=ProfileFiles(str(tmp_path / "*.ply"))), SETTINGS, None))
