"""``errormotion truth``: writes the true errors during a run on a virtual machine."""

from __future__ import annotations

from pathlib import Path

from errormotion import datasets
from errormotion.campaign.folder import RunFolder
from errormotion.campaign.truth import truth_of
from errormotion.cli.output import show
from errormotion.cli.page import new_files


def truth(run: Path, out: Path) -> None:
    """Write the true errors during a run as an error dataset.

    Raises
    ------
    RunError
        The run was not made on a virtual machine, so that the truth is unknown.
    DatasetError
        The file already exists.
    """
    new_files(None, out)
    datasets.save(truth_of(RunFolder.open(run)), out)
    show(f"written: {out}")
