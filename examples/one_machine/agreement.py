"""Compare the methods of this example with each other and with the truth: agreement.py [RUNS]."""

import argparse
from collections.abc import Iterator
from pathlib import Path

import xarray as xr

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.truth import truth_of
from errormotion.compare import compare
from errormotion.compare.text import probability, verdict


def newest(runs: Path) -> dict[str, RunFolder]:
    """Return the newest run of each test in a folder of runs."""
    folders = [RunFolder.open(file.parent) for file in sorted(runs.glob("*/run.json"))]
    return {str(folder.data["test"]): folder for folder in folders}


def questions(runs: dict[str, RunFolder]) -> Iterator[tuple[str, dict[str, xr.Dataset], tuple[str, ...]]]:
    """Yield each comparison: a title, results by name, and the common freedoms (empty: all)."""
    errors = {name: datasets.load(folder.errors) for name, folder in runs.items() if folder.errors}
    truth = {name: truth_of(folder) for name, folder in runs.items() if errors[name].attrs["component"] != "beam"}
    # The bar determines the tilt of the spindle, the balls the rotation of the axes: about Y and Z these differ.
    displacements = ("EX", "EY", "EZ", "EA")
    yield "the tool", {"bar": errors["bar"], "balls": errors["balls"], "truth": truth["balls"]}, displacements
    for i, y in enumerate(errors["carriage"]["y"].values):
        at = {"carriage": errors["carriage"].isel(position=i), "truth": truth["carriage"].isel(position=i)}
        yield f"the carriage at Y = {1e3 * y:.0f} mm", at, ()
    volumes = {name: errors[name] for name in ("volume-cold", "volume-warm")}
    yield "the volume", {**volumes, "truth": truth["volume-warm"]}, ()


def main() -> None:
    """Compare, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="?", type=Path, default=Path("runs"), help="folder with the runs of this example")
    for title, results, freedoms in questions(newest(parser.parse_args().runs)):
        found = compare(results, freedoms=freedoms)
        print(f"\nErrors of {title}, {', '.join(map(str, found['dof'].values))}")
        print("\n".join(verdict(found)))
        for j, pair in enumerate(found["pair"].values):
            en = abs(found["en"].values[j])
            share = (en[en == en] <= 1).mean()  # without unknown values (NaN)
            print(f"  {pair}: |En| <= 1 at {100 * share:.0f} %, p = {probability(found['p'].values[j])}")


if __name__ == "__main__":
    main()
