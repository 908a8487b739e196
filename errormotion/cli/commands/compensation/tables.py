"""``errormotion compensate table``: writes a compensation table for a control."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path

from errormotion.cli.commands.compensation.model import errors_of
from errormotion.cli.options import quantity, read_settings
from errormotion.cli.output import show, show_json
from errormotion.compensation.tables import axis_table, export, get
from errormotion.datasets.storage.disk import reading
from errormotion.datasets.units import Length, Time


@dataclass(frozen=True)
class Choice:
    """Options of the command; positions in m, quantities as text."""

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
        The errors cannot be read or do not determine a table, the table exceeds a limit of the control, or a file
        already exists. Nothing is written.
    """
    chosen = get(form)
    settings = read_settings(chosen.Settings, None, assignments)
    with reading(errors):
        made = axis_table(
            errors_of(errors),
            choice.axis.upper(),
            component=choice.component.upper(),
            step=None if choice.step is None else quantity("--step", choice.step, Length),
            at=choice.at,
            time=None if choice.time is None else quantity("--time", choice.time, Time),
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
