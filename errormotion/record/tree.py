"""A run as one tree of datasets."""

from __future__ import annotations

import json
from pathlib import Path

import xarray as xr

from errormotion.campaign.folder import RunFolder
from errormotion.datasets import load
from errormotion.datasets.files import events
from errormotion.datasets.provenance import plain

_STATED = ("id", "test", "created", "status", "reason")


def open_run(folder: str | Path) -> xr.DataTree:
    """Open a run folder as a tree of datasets.

    Parameters
    ----------
    folder : str or Path
        A run folder; the run may still be in progress.

    Returns
    -------
    DataTree
        Nodes, as far as they exist: ``raw`` (lazy), ``errors`` (the last identification, in memory), ``errors_<name>``
        for associated datasets, such as ``errors_monte_carlo``. The attributes of the root state the run: id, test,
        created, status, reason, machine, bench, campaign, method, and ``run`` and ``events``, the complete record and
        its notes as JSON.

    Raises
    ------
    RunError
        The path is not a run folder, or ``run.json`` is damaged.
    DatasetError
        A dataset cannot be read.
    """
    from errormotion.report.write import belonging

    run = RunFolder.open(folder)
    nodes: dict[str, xr.Dataset] = {}
    if run.raw.exists():
        nodes["raw"] = load(run.raw)
    if (file := run.errors) is not None:
        errors = nodes["errors"] = load(file)
        for each in belonging(errors, file):
            name = str(each.attrs["schema"]).split("/")[0].rpartition(".")[2]
            nodes[f"errors_{name}"] = each
    attrs = {name: str(run.data.get(name, "")) for name in _STATED}
    bench, campaign = run.data.get("bench", {}), run.data.get("campaign", {})
    attrs |= {"machine": bench.get("machine", ""), "bench": bench.get("name", ""), "campaign": campaign.get("name", "")}
    attrs |= {"method": run.data.get("method", {}).get("id", "")}
    attrs |= {"run": json.dumps(plain(run.data)), "events": json.dumps(plain(events.read(run.path)))}
    root = {"/": xr.Dataset(attrs=attrs)}
    return xr.DataTree.from_dict({**root, **nodes}, name=run.path.name)
