"""``errormotion bench probe``: reads every instrument of a bench once."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from errormotion.campaign.bench import OpenBench
from errormotion.campaign.claims import claimed, uses
from errormotion.campaign.files import BenchPlan, load_bench
from errormotion.cli.output import failure, show, show_json, table
from errormotion.errors import code_of

MAX_NUMBERS = 12
"""Largest number of values of a reading that are printed; a longer reading is summarized."""

log = logging.getLogger(__name__)


def probe(file: Path, as_json: bool) -> bool:
    """Open, identify and read every instrument of a bench; return whether all of them answered."""
    plan = load_bench(file)
    with claimed(uses(plan), "a probe of the bench"):
        return _probe(plan, as_json)


def _probe(plan: BenchPlan, as_json: bool) -> bool:
    bench = OpenBench(plan)
    found: list[dict[str, Any]] = []
    try:
        bench.try_open()
        for answer in bench.answers:
            record = answer.record() | {"error": answer.error, "code": answer.code, "reading": None}
            if answer.driver is not None:
                try:
                    record["reading"] = _plain(answer.driver.read())
                except Exception as error:
                    log.exception("instrument %s: the reading failed", answer.instrument.name)
                    record["error"] = f"{type(error).__name__}: {error}"
                    record["code"] = code_of(error, "error.internal")
            found.append(record)
    finally:
        bench.close()
    bad = [f"{record['name']}: {record['error']}" for record in found if record["error"]]
    good = not bad
    if as_json:
        about = {"bench": bench.plan.name, "machine": bench.plan.machine, "instruments": found}
        show_json({"ok": good, **about, **(failure("\n".join(bad), code="bench.not_ready") if bad else {})})
    else:
        rows = [
            [
                r["name"],
                r["driver"],
                _name(r["identity"]),
                f"FAILED: {r['error']}" if r["error"] else _short(r["reading"]),
            ]
            for r in found
        ]
        show(table(["instrument", "driver", "identity", "reading (SI)"], rows))
    return good


def _name(identity: dict[str, Any] | None) -> str:
    if identity is None:
        return "-"
    simulated = " (simulated)" if identity["simulated"] else ""
    return f"{identity['manufacturer']} {identity['model']} {identity['serial_number']}{simulated}"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def _short(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{k} {_short(v)}" for k, v in value.items())
    if isinstance(value, list):
        if len(value) > MAX_NUMBERS:
            return _summary(value)
        return ", ".join(_short(v) for v in value) or "none"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _summary(values: list[Any]) -> str:
    numbers = np.array([v for v in values if isinstance(v, int | float)], dtype=float)
    known = numbers[np.isfinite(numbers)]
    between = f", {known.min():.6g} to {known.max():.6g}" if known.size else ""
    return f"{len(values)} values, {known.size} known{between}"
