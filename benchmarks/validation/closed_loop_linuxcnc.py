"""The closed loop with the real LinuxCNC: it probes a warm-up, and two others with offsets in its servo thread.

``python benchmarks/validate.py closed_loop_linuxcnc --cache FOLDER``; for a single machine (several at a time need
separate network and IPC namespaces): ``PYTHONPATH=benchmarks python -m validation.closed_loop_linuxcnc SEED FOLDER``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from itertools import chain, count, islice
from pathlib import Path
from typing import Any

import numpy as np

from errormotion import datasets
from errormotion.campaign.compensation.compensating import Compensation
from errormotion.campaign.files import load_campaign
from errormotion.cli.commands.campaigns.run import work
from errormotion.cli.demo import compensated_probing
from errormotion.cli.demo.closed_loop import DISPLACEMENTS, with_warm_sensors
from errormotion.compensation.online.prediction import predictor
from errormotion.compensation.thermal_model import ThermalModelSettings, fit
from errormotion.instruments.simulators import world
from validation.closed_loop import VARIATION, individual

TITLE = "Closed loop on LinuxCNC"
SEEDS = 10
DEFAULT = False
"""It takes hours of real time and needs LinuxCNC, so that it runs only if it is named."""
FIRST = 100
"""Seed of the first machine."""
INTERVAL = 600.0
"""From one cycle to the next, simulated s."""
CYCLES = {"training": 16, "compensated": 13}
WARM_UPS = (2, 3)
"""Those with compensation."""
MODEL = ThermalModelSettings(variant="lagged", lags=(), most_sensors=2)
"""Only present temperatures: simulated minutes are skipped, and the compensation would assume seconds."""
BALLS = (0, 2, 3)
ROUTES = {"feedback": "linuxcnc_feedback", "external": "linuxcnc_offset"}


class Keeper:
    """Reference to the world of a machine between two runs."""

    def close(self) -> None:
        """Do nothing."""


def section(seeds: int, cache: Path | None = None) -> Iterator[str]:
    """Yield the lines of the section; machines whose result is in the cache are not run again."""
    folder = cache or Path(tempfile.mkdtemp(prefix="closed-loop-"))
    yield (
        f"{seeds} virtual C-frame machines, varied as above (up to {VARIATION:.0%}), under the real LinuxCNC on "
        f"simulated joints. Each touch is a motion of LinuxCNC in real time; between two cycles {INTERVAL / 60:g} "
        "simulated minutes are skipped, and the slew limit is therefore 20 um/s. A first warm-up of "
        f"{CYCLES['training']} cycles at 15000, then 5000 /min is probed (3 balls, 4 touches each), and a model is "
        "fitted to it: present temperatures of at most 2 sensors. In the second and the third warm-up, each from the "
        f"cold state, with random speeds and {CYCLES['compensated']} cycles, the code of `errormotion compensate run` "
        "reads the thermometers by Modbus and writes to LinuxCNC: in the feedback path, or as external offsets. "
        "`without`: root mean square of the true displacement (EX, EY, EZ together) of that warm-up, without "
        "compensation, at the times of the cycles after the cold one; `with`: the same as probed by LinuxCNC with "
        "the compensation, including the scatter of the probe (0.4 um in each touch). `following`: share of the "
        "decisions that change the offset; it is held while the machine probes, which takes most of the real time here."
    )
    yield from ("", "| machine | route | sensors | warm-up | without/um | with/um | remaining | following |")
    yield "|---|---|---|---|---|---|---|---|"
    remaining: list[float] = []
    kept = sorted(int(file.stem) for file in folder.glob("*.json") if file.stem.isdigit())
    new = (seed for seed in count(FIRST) if seed not in kept)
    for seed in islice(chain(kept, new), seeds):
        file = folder / f"{seed}.json"
        if not file.exists():
            subprocess.run(
                [sys.executable, "-m", "validation.closed_loop_linuxcnc", str(seed), str(folder)], check=True
            )
        each = json.loads(file.read_text())
        for number, found in each["warm_ups"].items():
            remaining.append(found["with"] / found["without"])
            yield (
                f"| {seed} | {each['route']} | {', '.join(each['sensors'])} | {number} | {found['without']:.2f} "
                f"| {found['with']:.2f} | {remaining[-1]:.1%} | {found['following']:.0%} |"
            )
    yield (
        f"\nMean of `remaining`: {np.mean(remaining):.1%}, largest {np.max(remaining):.1%}; larger than without: "
        f"{sum(each > 1 for each in remaining)} of {len(remaining)}."
    )


def closed(seed: int, folder: Path) -> dict[str, Any]:
    """Return the figures of one machine."""
    rng = np.random.default_rng([seed, 16])
    route = list(ROUTES)[seed % 2]
    here = world("cframe", seed)
    here.attach(Keeper())
    here.machine.state = individual("cframe", seed, np.random.default_rng([seed, 15])).state
    further = {number: _speeds(rng, here.machine.top_speed) for number in WARM_UPS}
    half = INTERVAL * CYCLES["training"] / 2

    def measured(name: str, schedule: list[tuple[float, float]]) -> tuple[Any, np.ndarray]:
        plan = load_campaign(_written(folder, name, seed, route, schedule))
        (run,) = work(plan, runs=folder, quiet=True, with_report=False)
        with datasets.load(run.errors or run.path) as errors:
            errors.load()
        truth = here.machine.truth_probing(errors["time"].values, errors.attrs["functional_point"])
        true = np.stack([truth[each].values for each in DISPLACEMENTS], axis=-1)
        return errors, true[1:] - true[0]

    kept = folder / f"{seed}-training.nc"  # of a run that was interrupted
    if not kept.exists():
        here.start([])
        datasets.save(measured("training", [(0.0, 15000.0), (half, 5000.0)])[0], kept)
    with datasets.load(kept) as training:
        model = fit([with_warm_sensors(training.load())], MODEL)
    warm_ups = {}
    for number, speeds in further.items():
        done = folder / f"{seed}-{number}.json"
        if not done.exists():
            bench = load_campaign(_written(folder, "compensated", seed, route, speeds)).bench
            here.start([])  # cold: the first readings are the reference
            compensation = Compensation(bench, model.dataset, folder, arm=bench.machine)
            states: Counter[str] = Counter()
            with compensated_probing.following(compensation, states):
                after, without = measured("compensated", speeds)
            figures = {
                "without": 1e6 * _size(without),
                "with": 1e6 * _size(_displacement(after)),
                "following": states["following"] / states.total(),
            }
            _keep(done, figures)
        warm_ups[str(number)] = json.loads(done.read_text())
    sensors = list(predictor(model.dataset).temperatures)
    return {"seed": seed, "route": route, "sensors": sensors, "warm_ups": warm_ups}


def _speeds(rng: np.random.Generator, top_speed: float) -> list[tuple[float, float]]:
    """Return random speeds of a compensated warm-up."""
    at, found = 0.0, []
    while at < INTERVAL * CYCLES["compensated"]:
        found.append((at, float(np.round(rng.uniform(3000, top_speed), -2))))
        at += rng.uniform(600, 1500)
    return found


def _displacement(errors: Any) -> np.ndarray:
    """Return the measured displacement after the cold cycle, (n, 3)."""
    values = np.stack([errors[each].values for each in DISPLACEMENTS], axis=-1)
    return np.asarray(values[1:] - values[0])


def _size(displacement: np.ndarray) -> float:
    return float(np.sqrt((displacement**2).sum(axis=1).mean()))


def _written(folder: Path, name: str, seed: int, route: str, schedule: list[tuple[float, float]]) -> Path:
    """Write the demonstration's bench and campaign for a machine."""
    source = compensated_probing.CAMPAIGN
    bench = (source.parent / "compensated_bench.toml").read_text()
    bench = bench.replace("seed=3", f"seed={seed}").replace("route=feedback", f"route={route}")
    bench = bench.replace("linuxcnc_feedback", ROUTES[route])
    bench = bench.replace('driver = "linuxcnc"', 'driver = "linuxcnc"\ntimeout = "10 s"')  # a busy computer
    bench = bench.replace("repeats = 1", 'repeats = 1\ncontroller_settings = { timeout = "10 s" }')
    (folder / f"{seed}-bench.toml").write_text(bench)
    nominal = 1e3 * world("cframe", seed).machine.balls.nominal
    balls = ", ".join(
        f'{{ name = "B{k + 1}", centre = [{", ".join(f"""{chr(34)}{x:.3f} mm{chr(34)}""" for x in nominal[k])}] }}'
        for k in BALLS
    )
    speeds = ", ".join(f'{{ at = "{at:.0f} s", spindle_speed = "{speed:.0f} /min" }}' for at, speed in schedule)
    file = folder / f"{seed}-{name}.toml"
    file.write_text(f"""schema = "errormotion.campaign/1"
name = "Closed loop, {name}"
bench = "{seed}-bench.toml"

[[test]]
name = "probing"
method = "normal_vector"
[test.settings]
balls = [{balls}]
touches = 4
approach = "2 mm"
overtravel = "1 mm"
duration = "{INTERVAL * (CYCLES[name] - 1):.0f} s"
interval = "{INTERVAL:.0f} s"
schedule = [{speeds}]
tool_axes = "Z"
""")
    return file


def main() -> None:
    """Run one machine, and write its figures."""
    seed, folder = int(sys.argv[1]), Path(sys.argv[2]).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    _keep(folder / f"{seed}.json", closed(seed, folder))


def _keep(file: Path, values: dict[str, Any]) -> None:
    partial = file.with_suffix(".part")
    partial.write_text(json.dumps(values))
    partial.rename(file)
    print(values)


if __name__ == "__main__":
    main()
