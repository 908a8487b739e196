"""Runs that a terminal or another program executes: their folders are locked."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from pathlib import Path

from errormotion.campaign.background.processes import Background
from errormotion.campaign.folder import RunFolder, is_locked
from errormotion.campaign.runner import MEASURING, stored_plan
from errormotion.campaign.storage.store import committed_length
from errormotion.datasets.files.containers import MAX_METADATA
from errormotion.datasets.files.reading import parse_json, read_bytes
from errormotion.errors import ErrormotionError

MAX_FOLDERS = 1000
"""Number of run folders that are examined, from the newest on."""


def runs_of_other_processes(runs: Path, known: Collection[str]) -> list[Background]:
    """Return the running campaigns whose run folders are not among the names ``known``.

    Each is described like a background process; only the program that started it can stop it.
    """
    return [] if not runs.is_dir() else list(_found(runs, known))


def _found(runs: Path, known: Collection[str]) -> Iterator[Background]:
    folders = sorted((path for path in runs.iterdir() if not path.name.startswith(".")), key=lambda path: path.name)
    for path in reversed(folders[-MAX_FOLDERS:]):
        if path.name in known or not path.is_dir() or not _is_running(path):
            continue
        try:
            folder = RunFolder.open(path)
            if folder.data.get("status") == "running" and "campaign" in folder.data:
                yield _described(folder)
        except (ErrormotionError, LookupError, TypeError, AttributeError, ValueError):
            continue  # an incomplete folder, or not one of a campaign


def _is_running(path: Path) -> bool:
    try:
        return is_locked(path)
    except ImportError:  # Windows: no lock
        return False


def _described(folder: RunFolder) -> Background:
    data = folder.data
    test, steps = str(data["test"]), [step for step in data["steps"] if isinstance(step, dict)]
    tests = [str(name) for name in data["campaign"]["tests"]]
    last = str(steps[-1].get("step", "")) if steps else ""
    measuring = not data["acquired"]
    done, expected = _progress(folder) if measuring else (math.nan, math.nan)
    return Background(
        name=folder.path.name,
        campaign=str(data["campaign"]["name"]),
        machine=str(data["bench"]["machine"]),
        started=str(data["created"]),
        alive=True,
        test=test,
        stage=MEASURING if measuring else "reporting" if last == "identify" else "identifying",
        number=tests.index(test) if test in tests else 0,
        total=len(tests),
        done=done,
        expected=expected,
        tests={test: folder.path.name},
    )


def _progress(folder: RunFolder) -> tuple[float, float]:
    """Return the length of a measurement on disk and its expected length: s for evenly spaced samples, else items."""
    test = next(each for each in stored_plan(folder).tests if each.name == folder.data["test"])
    method = test.method()
    expected = float(method.progress(test.settings))
    root = folder.raw / "zarr.json"
    if not root.exists():
        return 0.0, expected
    samples = committed_length(folder.raw, method.append_dim(test.settings))
    attributes = parse_json(read_bytes(root, MAX_METADATA)).get("attributes", {})
    rate = attributes.get("sample_rate")
    return samples / float(rate) if rate else float(samples), expected
