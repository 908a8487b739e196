"""``errormotion demo --controller linuxcnc --compensate``: LinuxCNC probes a warm-up and compensates another.

Both warm-ups have the same speeds. In the second one the compensation runs in parallel to the campaign: it reads the
thermometers, and LinuxCNC adds its offsets in the servo thread.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import xarray as xr

from errormotion import datasets
from errormotion.campaign.compensation.compensating import Compensation
from errormotion.campaign.files import load_campaign
from errormotion.campaign.folder import RunFolder
from errormotion.cli.commands.campaigns.run import describe, work
from errormotion.cli.commands.compensation.effect import plain
from errormotion.cli.demo.closed_loop import with_warm_sensors
from errormotion.cli.output import show, show_json, table
from errormotion.compensation.effect import effect
from errormotion.compensation.effect.text import HEAD, rows, verdict
from errormotion.compensation.thermal_model import ThermalModelSettings, fit
from errormotion.errors import ErrormotionError

CAMPAIGN = Path(__file__).parent / "linuxcnc" / "compensated.toml"
MODEL = ThermalModelSettings(variant="lagged", lags=())
"""Present temperatures only: the compensation would evaluate lags in real time, which differs from simulated time."""
RAMP_TIMEOUT = 15.0
"""Time within which the offset is zero after the second warm-up, s."""


def run(runs: Path, as_json: bool, campaign: Path = CAMPAIGN) -> None:
    """Run both warm-ups, and print the effect of the compensation.

    Raises
    ------
    BenchError
        LinuxCNC is not installed, or does not start.
    """
    start = time.monotonic()
    plan = load_campaign(campaign)
    (first,) = work(plan, runs=runs, quiet=as_json)
    before = _errors(first)
    model = fit([with_warm_sensors(before)], MODEL)
    compensation = Compensation(plan.bench, model.dataset, runs, arm=plan.bench.machine)
    states: Counter[str] = Counter()
    with following(compensation, states):
        (second,) = work(plan, runs=runs, quiet=as_json)
    found = effect(before, _errors(second))
    model.save(compensation.folder.path / "model.nc")
    seconds = time.monotonic() - start
    if as_json:
        tests = [describe(folder) for folder in (first, second)]
        show_json({"ok": True, "seconds": seconds, "tests": tests, "states": dict(states), "effect": plain(found)})
        return
    control = second.data["instruments"][0]["identity"]
    length = f"{float(before['time'][-1]) / 60:.0f} minutes"
    show(
        f"{control['manufacturer']} {control['model']} {control['firmware']} moved and probed; two warm-ups of {length}"
    )
    show(f"in {seconds:.0f} s, the second one with offsets of a model that was fitted to the first one.\n")
    show("\n".join([*verdict(found), "", table(HEAD, rows(found))]))
    total = sum(states.values())
    fractions = ", ".join(f"{name} {100 * count / total:.0f} %" for name, count in states.most_common())
    show(f"\ncompensation: {fractions}; its log is in {compensation.folder.path}")
    for folder in (first, second):
        show(f"report: {describe(folder)['report']}")


def _errors(folder: RunFolder) -> xr.Dataset:
    with datasets.load(folder.errors or folder.path) as errors:
        return errors.load()


@contextmanager
def following(compensation: Compensation, states: Counter[str]) -> Iterator[None]:
    """Compensate in another thread; after the block the offset ramps to zero.

    Raises
    ------
    ErrormotionError
        The compensation ended before.
    """
    failure: list[ErrormotionError] = []

    def follow() -> None:
        try:
            for moment in compensation.follow():
                states[str(moment.step.state)] += 1
        except ErrormotionError as error:
            failure.append(error)

    with compensation:
        thread = threading.Thread(target=follow, name="compensation", daemon=True)
        thread.start()
        try:
            yield
        finally:
            compensation.stop()
            thread.join(RAMP_TIMEOUT)
    if failure:
        raise failure[0]
