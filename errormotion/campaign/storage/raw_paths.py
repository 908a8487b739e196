"""Paths of raw data: of a file, a run folder, a folder of run folders."""

from __future__ import annotations

from pathlib import Path

from errormotion.datasets.files.reading import visible


def raw_of(path: Path) -> Path:
    """Return the raw dataset of a path: of a run folder, its raw store."""
    return path / "raw.zarr" if (path / "run.json").exists() else path


def is_runs_folder(path: Path) -> bool:
    """Return whether a path is a folder of run folders."""
    return path.is_dir() and not (path / "run.json").exists() and bool(visible(path, "*/run.json"))
