"""Draw docs/figures/readme_comparison.png from the runs of examples/one_machine: readme_comparison.py [RUNS]."""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.truth import truth_of
from errormotion.compare import compare
from errormotion.datasets.timing import between

TESTS = {"bar": ("five sensors on a bar", "#1f5a96"), "balls": ("four balls, probed", "#d9822b")}
PAIRS = {"bar - balls": "#5b5f66", "bar - truth": "#1f5a96", "balls - truth": "#d9822b"}
FREEDOMS = ("EX", "EY", "EZ")
TRUTH = "#8a8f98"


def results(runs: Path) -> dict[str, xr.Dataset]:
    """Return the errors of the newest runs of both tests, and the truth of the first one."""
    found = {}
    for test in TESTS:
        folders = sorted(runs.glob(f"*-{test}-*"))
        if not folders:
            raise SystemExit(f"No run of '{test}' in '{runs}': 'errormotion run examples/one_machine/campaign.toml'.")
        folder = RunFolder.open(folders[-1])
        found[test] = datasets.load(folder.errors or folder.path).load()
        if "truth" not in found:
            found["truth"] = truth_of(folder)
    return {name: found[name] for name in (*TESTS, "truth")}


def draw(curve: Axes, strip: Axes, errors: dict[str, xr.Dataset], comparison: xr.Dataset, freedom: str) -> None:
    """Draw one freedom of all methods over the truth, and below the normalised error of each pair."""
    zero, k = comparison.attrs["start"], list(comparison["dof"].values).index(freedom)
    hours = comparison["time"].values / 3600
    for name, ds in errors.items():
        at = between(zero, ds.attrs["start"])
        times = ds["time"].values + at
        since = comparison.attrs["since"]
        if name == "balls":
            i = list(comparison["dataset"].values).index(name)
            value = comparison["value"].values[i, :, k]
            expanded = 2 * np.sqrt(comparison["covariance"].values[i, :, k, k])
            curve.errorbar(
                hours, 1e6 * value, 1e6 * expanded, fmt="o", ms=3.2, lw=1.1, capsize=1.8, color=TESTS[name][1], zorder=3
            )
            continue
        change = ds.em.since(float(times[np.argmin(np.abs(times - since))] - at))
        value, inside = 1e6 * change[freedom].values, times >= since
        if name == "truth":
            curve.plot(times[inside] / 3600, value[inside], color=TRUTH, lw=4, alpha=0.45, zorder=0)
            continue
        expanded = 1e6 * change.em.expanded().sel(dof=freedom).values
        colour = TESTS[name][1]
        band = (value - expanded)[inside], (value + expanded)[inside]
        curve.fill_between(times[inside] / 3600, *band, color=colour, alpha=0.25, lw=0, zorder=1)
        curve.plot(times[inside] / 3600, value[inside], color=colour, lw=1.1, zorder=2)
    curve.set(title=f"{freedom} of the tool, µm")
    strip.axhspan(-1, 1, color="#2e8b57", alpha=0.13, lw=0)
    strip.axhline(0, color="#2e8b57", lw=0.6)
    for pair, colour in PAIRS.items():
        j = list(comparison["pair"].values).index(pair)
        strip.plot(hours, comparison["en"].values[j, :, k], ".-", ms=4, lw=0.8, color=colour)
    strip.set(ylim=(-1.6, 1.6), yticks=(-1, 0, 1), xlabel="hours of warm-up", xlim=(0, 3.1))


def main() -> None:
    """Draw and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="?", type=Path, default=Path("runs"), help="folder with the runs of the example")
    errors = results(parser.parse_args().runs)
    comparison = compare(errors, freedoms=FREEDOMS, causes=False)
    plt.rcParams.update({"font.size": 10, "axes.titlesize": 11, "axes.spines.top": False, "axes.spines.right": False})
    figure, axes = plt.subplots(2, 3, figsize=(10, 5), height_ratios=(2.4, 1), sharex=True, layout="constrained")
    for column, freedom in enumerate(FREEDOMS):
        draw(*axes[:, column], errors, comparison, freedom)
    axes[1, 0].set_ylabel("$E_n$")
    handles = [Line2D([], [], color=TRUTH, lw=4, alpha=0.45, label="truth of the virtual machine")]
    handles += [
        Line2D(
            [],
            [],
            color=colour,
            lw=1.4,
            marker="o" if name == "balls" else "",
            ms=4,
            label=f"{name}: {label}, with $U$ (95 %)",
        )
        for name, (label, colour) in TESTS.items()
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False)
    below = [Line2D([], [], color=colour, marker=".", lw=0.8, label=pair) for pair, colour in PAIRS.items()]
    below.append(Patch(color="#2e8b57", alpha=0.13, lw=0, label="agree: $|E_n|$ at most 1"))
    figure.legend(handles=below, loc="outside lower center", ncols=4, frameon=False)
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.06)
    figure.savefig(Path(__file__).with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
