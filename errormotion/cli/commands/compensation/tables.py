"""``errormotion compensate``: tables of corrections for controllers."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from errormotion.cli.commands.compensation.model import errors_of
from errormotion.cli.output import show, show_json
from errormotion.cli.settings import read_settings
from errormotion.compensation.tables import axis_table, export, get
from errormotion.datasets.storage.disk import reading
from errormotion.datasets.units import Length, Time
from errormotion.errors import DatasetError


@dataclass(frozen=True)
class Choice:
    """What of the errors a table is made of; texts as they were typed."""

    axis: str
    component: str
    step: str | None
    at: tuple[float, float, float]
    time: str | None
    functional_point: tuple[float, float, float] | None
    chain: str


def table(errors: Path, form: str, choice: Choice, out: Path, assignments: list[str], as_json: bool) -> None:
    """Write the table of one axis, and print its errors.

    Raises
    ------
    PluginError
        No such format.
    DatasetError
        The errors cannot be read or make no table, the control would refuse it, or a file exists. Nothing is written.
    """
    chosen = get(form)
    settings = read_settings(chosen.Settings, None, assignments)
    with reading(errors):
        made = axis_table(
            errors_of(errors),
            choice.axis.upper(),
            component=choice.component.upper(),
            step=_quantity("--step", choice.step, Length),
            at=choice.at,
            time=_quantity("--time", choice.time, Time),
            functional_point=choice.functional_point,
            chain=choice.chain,
            run=errors.resolve().name,
        )
    exported = export(made, chosen, settings)
    paths = [str(path) for path in exported.save(out)]
    if as_json:
        figures = {name: value for name, value in asdict(exported).items() if name != "files"}
        known = {name: None if isinstance(v, float) and math.isnan(v) else v for name, v in figures.items()}
        show_json({"ok": True, "files": paths, "format": chosen.id, "source": chosen.source, **known})
        return
    for path in paths:
        show(path)
    u = exported.uncertainty
    show(
        f"  {chosen.title}: {exported.points} points, largest offset {1e6 * exported.largest:.2f} um\n"
        f"  uncertainty of the correction (k = 2): {'unknown' if math.isnan(u) else f'{2e6 * u:.2f} um'}\n"
        f"  rounding in the file: {1e6 * exported.rounding:.3f} um; table against correction, between points as well: "
        f"{1e6 * exported.interpolation:.3f} um"
    )
    for remark in exported.remarks:
        show(f"  note: {remark}")
    show(f"  format from: {chosen.source}")


def _quantity(option: str, text: str | None, kind: Any) -> float | None:
    """Return a length or time with its unit in SI; None where it is not stated."""
    if text is None:
        return None
    try:
        value: float = TypeAdapter(kind).validate_python(text)
    except ValidationError as error:
        reason = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise DatasetError(f"{option} {text}: {reason}") from None
    return value
