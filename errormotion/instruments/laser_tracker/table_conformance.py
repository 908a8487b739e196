"""Table of lengths for the conformance kit."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from errormotion.instruments.temporary import temporary_folder


@cache
def length_table() -> Path:
    """Return a table of lengths from three stations to five targets; one beam was broken."""
    lines = [f"S{k},{i},{1500 + 100 * k + 7 * i:.4f},20.{i},1013.2,45" for k in range(3) for i in range(5)]
    lines[7] = "S1,2,,20.2,1013.2,45"
    path = temporary_folder() / "lengths.csv"
    path.write_text(
        "\n".join(["station,target,length [mm],temperature [degC],pressure [hPa],humidity [%]", *lines]) + "\n",
        encoding="utf-8",
    )
    return path
