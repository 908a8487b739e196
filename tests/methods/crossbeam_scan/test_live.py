"""What the person at the machine sees."""

import numpy as np
import pytest
import xarray as xr

from errormotion.methods.crossbeam_scan import simulation
from errormotion.methods.crossbeam_scan.acquisition.live import QUEUE_LENGTH, LiveScans
from errormotion.methods.crossbeam_scan.settings import CrossbeamScanSettings
from errormotion.twin.sensors.profiler import Disturbances, Profiler

POSITIONS = (0.1, 0.3)
SETTINGS = CrossbeamScanSettings(positions=POSITIONS, warm_up=(7200.0,), cold_repeats=0, scan_length=400 * 70e-6)


@pytest.fixture(scope="module")
def scans(gantry):
    """A cold and a warm pass over two artefacts, cut."""
    profiler = Profiler(800, 50e-6, disturbances=Disturbances.white())
    return simulation.raw_scans(
        gantry, [0.0, 7200.0], POSITIONS, seed=2, profiles=400, profiler=profiler, motion="rigid"
    )


def chunks(scans, size=150):
    """Yield the passes as they would be recorded, some lines beyond the scans included."""
    static = scans.drop_vars(["height", "y", "time"]).assign(
        encoder_pitch=1e-6, encoder_zero=0.0, scan_length=SETTINGS.scan_length, warm_up=("cycle", [0.0, 7200.0])
    )
    for cycle in range(2):
        heights = np.concatenate([np.pad(scans["height"].values[cycle, k], ((0, 20), (0, 0))) for k in range(2)])
        y = np.concatenate([scans["y"].values[cycle, k] + POSITIONS[k] for k in range(2)])
        y = np.concatenate([np.concatenate([part, part[-1] + np.arange(1, 21) * 70e-6]) for part in np.split(y, 2)])
        for low in range(0, y.size, size):
            part = slice(low, low + size)
            yield static.assign(
                record=(("line", "point"), heights[part]),
                encoder=("line", y[part] * 1e6),
                cycle_of_line=("line", np.full(y[part].size, cycle)),
                line_time=("line", np.full(y[part].size, 7200.0 * cycle)),
            )


def test_progress_states_pass_artefact_and_last_registration(scans, gantry):
    live = LiveScans(SETTINGS)
    said = []
    for chunk in chunks(scans):
        said.append(live.update(chunk))
        live.wait()
    assert said[0] == "pass 1 of 2, artefact 1 of 2"
    assert said[-1].startswith("pass 2 of 2, artefact 2 of 2; pass 2, artefact ")
    text = live.text(2, 2).partition("; pass 2, artefact 2: ")[2]
    numbers = text.replace("(", "").replace(")", "").split()
    found = {numbers[k]: (float(numbers[k + 1]), float(numbers[k + 2])) for k in range(len(numbers) - 2) if
             numbers[k] in ("EX", "EY", "EZ", "EA", "EB", "EC")}  # fmt: skip
    true = gantry.crossbeam.twist(7200.0, POSITIONS[1]) * [1e6, 1e6, 1e6, *[np.degrees(3600.0)] * 3]
    for k, name in enumerate(("EX", "EY", "EZ", "EA", "EB", "EC")):
        value, size = found[name]
        assert abs(value - true[k]) < 5 * size + 0.06  # what is printed is rounded to 0.1 um


def test_update_never_waits_and_the_thread_ends(scans, monkeypatch):
    live = LiveScans(SETTINGS)
    import threading

    gate = threading.Event()
    register = live._register
    monkeypatch.setattr(live, "_register", lambda job: (gate.wait(10), register(job)))
    for _ in range(3):
        for chunk in chunks(scans):
            live.update(chunk)  # the worker is held up: this would hang if it waited for it
    waiting = len(live._waiting)
    gate.set()
    live.wait()
    assert waiting <= len(POSITIONS) + QUEUE_LENGTH
    assert live._thread is None


def test_failed_registration_is_reported_without_an_end(scans):
    live = LiveScans(SETTINGS)
    for chunk in chunks(scans):
        flat = xr.zeros_like(chunk["record"])
        live.update(chunk.assign(record=flat))
    live.wait()
    assert "pass " in live.text(2, 2)
    assert ": " in live.text(2, 2)


def test_mark_is_not_taken_for_a_scan(scans):
    live = LiveScans(SETTINGS)
    first = next(chunks(scans))
    mark = first.isel(line=slice(0, 1)).assign(encoder=("line", [np.nan]))
    assert live.update(mark) == ""


def test_progress_of_a_pocket_states_the_lift(gantry):
    raw = simulation.raw_pocket(gantry, seed=1, profiles=20)
    assert LiveScans(CrossbeamScanSettings(procedure="profiler_pose")).update(raw) == "pocket, scan at a lift of 182 mm"
