"""A run folder that is moved or deleted while data are written to it: the message states that it is missing."""

import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from errormotion.campaign import runner
from errormotion.campaign.files import CampaignPlan, parse_bench
from errormotion.campaign.monitor.watch import Monitor
from errormotion.campaign.storage.recorder import Recorder
from errormotion.campaign.storage.store import RawStore
from errormotion.errors import RunError

GONE = "is missing: it was moved or deleted while data were written"
THERMOMETER = """\
schema = "errormotion.bench/1"
name = "Shop"
machine = "Mill 5"
[instruments.modules]
driver = "dcon_temperature"
address = "sim://cframe/t?seed=11&sensors=spindle_front,column"
channels = ["spindle", "column"]
"""


def moved(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))


def replaced(path: Path) -> None:
    moved(path)
    path.mkdir()


@pytest.fixture(params=[moved, shutil.rmtree, replaced], ids=["moved", "deleted", "replaced"])
def loss(request: pytest.FixtureRequest) -> Callable[[Path], None]:
    """Return what happens to a folder."""
    return request.param


def chunk(first: int) -> xr.Dataset:
    return xr.Dataset({"a": ("time", np.arange(first, first + 10.0))}, attrs={"sample_rate": 10.0})


def test_a_store_writes_nothing_at_the_former_place_of_its_folder(tmp_path: Path, loss: Callable[[Path], None]) -> None:
    path = tmp_path / "run" / "raw.zarr"
    path.parent.mkdir()
    store = RawStore.create(path, chunk(0), "time")
    store.append(chunk(0))
    store.commit()
    loss(path.parent)
    store.append(chunk(10))
    with pytest.raises(RunError, match=GONE):
        store.commit()
    assert not path.exists()


@pytest.mark.parametrize("inside", [False, True])
def test_the_recorder_reports_it(tmp_path: Path, loss: Callable[[Path], None], inside: bool) -> None:
    """The folder around the store, or the store itself."""
    path = tmp_path / "run" / "raw.zarr"
    path.parent.mkdir()

    def record() -> None:
        with Recorder(path, "time", 100, {}) as recorder:
            recorder.put(chunk(0))
            while not recorder.committed:
                time.sleep(0.01)
            loss(path if inside else path.parent)
            recorder.put(chunk(10))

    with pytest.raises(RunError, match=GONE):
        record()


def test_a_campaign_ends_with_the_reason_and_continues_in_the_moved_folder(
    plan: Callable[..., CampaignPlan], tmp_path: Path
) -> None:
    class Mover(runner.Quiet):
        def advance(self, done: float) -> None:
            if done >= 0.5 and not list(tmp_path.glob("*-a-*")):
                (path,) = (tmp_path / "runs").iterdir()
                path.rename(tmp_path / path.name)

    with pytest.raises(RunError, match=r"its folder .* is gone. It was moved or deleted during the run. \d+ samples"):
        runner.run(plan('name = "a"\nsettings = {count = 100000}'), progress=Mover())
    assert len(list(tmp_path.glob("*-a-*"))) == 1
    assert not list((tmp_path / "runs").glob("*/run.json"))
    (finished,) = runner.resume(runs=tmp_path)
    assert finished.data["samples"]["count"] == 100000


def test_a_monitor_ends_with_the_reason(tmp_path: Path, loss: Callable[[Path], None]) -> None:

    def watch() -> None:
        with Monitor(parse_bench(THERMOMETER, Path("bench.toml")), tmp_path, 0.01) as monitor:
            for snapshot in monitor.watch(20.0):
                if snapshot.logged == 3:
                    loss(monitor.folder.path)

    with pytest.raises(RunError, match=GONE):
        watch()
