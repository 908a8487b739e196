"""``errormotion truth``: the true errors behind a run on a virtual machine."""

from __future__ import annotations

from pathlib import Path

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.truth import truth_of
from errormotion.cli.output import show
from errormotion.errors import DatasetError


def truth(run: Path, out: Path) -> None:
    """Write the truth behind a run as an error dataset.

    Raises
    ------
    RunError
        The run states no truth.
    DatasetError
        The file exists already.
    """
    if out.exists():
        raise DatasetError(f"{out}: exists already, and a result is never overwritten; give another name")
    datasets.save(truth_of(RunFolder.open(run)), out)
    show(f"written: {out}")
