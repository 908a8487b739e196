"""Random files of laboratories are proposed rightly, asked for, or refused: never read wrongly without a word."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest

from errormotion.datasets.importing import import_files
from errormotion.datasets.maps.proposal import propose
from errormotion.datasets.maps.writing import text_of, write_map
from errormotion.errors import DatasetError

FILES = 40
"""Files of each kind."""
READ = 0.9
"""Smallest share of files that are read; the others leave something open that no answer of this test says."""
PROPOSED = 0.5
"""Smallest share of files whose proposed map is complete; a quarter of them state no units."""
BEAMS = {
    "values.beam_origin": '["6 0 10 mm", "6 0 50 mm", "0 6 10 mm", "0 6 50 mm", "0 0 -1 mm"]',
    "values.beam_direction": "[[-1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, -1, 0], [0, 0, 1]]",
    "values.bar_radius": "5 mm",
    "values.distance_noise": "0.3 um",
    "values.level": '["10 mm", "50 mm"]',
}
SCALE = {"m": 1.0, "mm": 1e-3, "µm": 1e-6, "um": 1e-6, "s": 1.0, "min": 60.0}


class File:
    """Columns with titles, units and cells, written in a random form."""

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.columns: list[tuple[str, str, list[str]]] = []
        self.decimal = rng.choice(".,")
        self.delimiter = rng.choice([sign for sign in ";\t,|" if sign != self.decimal])
        self.units = rng.choice(("brackets", "below", "none", "slash"))

    def add(self, titles: tuple[str, ...], unit: str, cells: list[str]) -> str:
        title = self.rng.choice(titles)
        self.columns.append((title, unit, cells))
        return title

    def numbers(self, titles: tuple[str, ...], unit: str, values: np.ndarray, digits: int) -> tuple[str, np.ndarray]:
        """Add a column; return its title and the numbers that stand in the file."""
        texts = [f"{value:.{digits}f}" for value in values]
        title = self.add(titles, unit, [text.replace(".", self.decimal) for text in texts])
        return title, np.array([float(text) for text in texts])

    def write(self, path: Path) -> None:
        titles = [title for title, _, _ in self.columns]
        units = [unit for _, unit, _ in self.columns]
        form = {"brackets": "{} [{}]", "slash": "{} / {}"}.get(self.units, "{}")
        lines = self.rng.choice(([], ["Messprotokoll", "Bediener: Meier", ""], ["# exported"]))
        lines = [*lines]
        lines.append(self.delimiter.join(form.format(t, u) if u else t for t, u in zip(titles, units, strict=True)))
        if self.units == "below":
            lines.append(self.delimiter.join(unit or "-" for unit in units))
        lines += [self.delimiter.join(row) for row in zip(*(cells for _, _, cells in self.columns), strict=True)]
        encoding = self.rng.choice(("utf-8", "utf-8-sig", "cp1252", "utf-16"))
        path.write_bytes((self.rng.choice(("\n", "\r\n")).join(lines) + "\n").encode(encoding))


def clock(rng: random.Random, file: File, n: int, answers: dict[str, str]) -> np.ndarray:
    """Add the times of a file; return them in s."""
    kind = rng.choice(("numbers", "iso", "german", "two columns", "american"))
    start, step = rng.randrange(86400), rng.choice((1, 10, 60))
    seconds = start + step * np.arange(n)
    if kind == "numbers":
        unit = rng.choice(("s", "min"))
        _, found = file.numbers(("Zeit", "time", "t", "Elapsed time"), unit, (seconds - start) / SCALE[unit], 4)
        answers["units.time"] = unit
        return found * SCALE[unit]
    days, rest = np.divmod(seconds, 86400)
    day = rng.choice((4, 20))
    dates = {"iso": "2026-05-{:02d}", "american": "05/{:02d}/2026"}.get(kind, "{:02d}.05.2026")
    first = [dates.format(day + d) for d in days]
    second = [f"{r // 3600:02d}:{r // 60 % 60:02d}:{r % 60:02d}" for r in rest]
    answers["units.time"] = {"iso": "iso8601", "american": "mm/dd/yyyy"}.get(kind, "dd.mm.yyyy")
    if kind == "two columns":
        file.add(("Datum", "Date"), "", first)
        file.add(("Zeit", "Time", "Uhrzeit"), "", second)
    else:
        file.add(("Datum", "Date", "Zeit", "Timestamp"), "", [f"{a} {b}" for a, b in zip(first, second, strict=True)])
    return (seconds - start).astype(float)


def drift(rng: random.Random, path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Write the log of a spindle; return the answers of a person, and the truth."""
    file, answers, n = File(rng), dict(BEAMS), rng.randint(6, 40)
    if rng.random() < 0.3:
        file.add(("Nr", "Sample"), "", [str(k + 1) for k in range(n)])
    truth = {"time": clock(rng, file, n, answers)}
    unit = rng.choice(("µm", "um", "mm"))
    answers["units.distance"] = unit.replace("µ", "u")
    form = rng.choice(("{}", "Sensor {}", "Weg {}", "Kanal {}"))
    labels = ["X1", "X2", "Y1", "Y2", "Z"]
    if stated := rng.random() < 0.6:
        rng.shuffle(labels)
    distances = {}
    for k, label in enumerate(labels):
        title = form.format(label if stated else k + 1 if form != "{}" else "abcde"[k])
        values = (1e-3 + np.array([rng.gauss(0, 2e-6) for _ in range(n)])) / SCALE[unit]
        answers[f"columns.distance.{label}"], numbers = file.numbers((title,), unit, values, 3 if unit != "mm" else 6)
        distances[label] = numbers * SCALE[unit]
    truth["distance"] = np.array([distances[label] for label in ("X1", "X2", "Y1", "Y2", "Z")])
    if rng.random() < 0.6:
        _, warm = file.numbers(("T Rahmen", "Temp frame", "Temperatur"), "°C", 20 + np.arange(n) / n, 2)
        truth["temperature"] = warm[:, None]
        answers["units.temperature"] = "degC"
    if rng.random() < 0.4:
        _, speed = file.numbers(("Drehzahl", "Spindle speed", "n"), "1/min", np.full(n, 15000.0), 0)
        truth["spindle_speed"] = speed
        answers["units.spindle_speed"] = "/min"
    file.write(path)
    return answers | {"raw": "errormotion.raw.spindle_drift/1, drift"}, truth


def positioning(rng: random.Random, path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Write a positioning test in one of its layouts."""
    file, runs, targets = File(rng), rng.randint(1, 4), rng.randint(3, 8)
    answers = {"attributes.axis": "X", "columns.deviation": "EXX", "units.target_position": "mm"}
    unit = rng.choice(("µm", "um"))
    answers["units.deviation"] = "um"
    positions = np.cumsum([rng.uniform(40, 120) for _ in range(targets)]).round(2)
    error = np.array([[[rng.gauss(0, 3) for _ in range(targets)] for _ in range(2)] for _ in range(runs)]).round(2)
    layout = rng.choice(("measured", "long", "matrix", "actual"))
    names = ("Position", "Pos", "Sollposition", "Target position")
    deviations = ("Abweichung", "Error", "Fehler", "Deviation")
    order = [
        (r, w, t) for r in range(runs) for w in (0, 1) for t in (range(targets) if w == 0 else range(targets)[::-1])
    ]
    if layout == "matrix":
        file.numbers((*names, "Target"), "mm", positions, 2)
        plus, minus = rng.choice((("+", "-"), (" vor", " zurück"), (" up", " down")))
        for r in range(runs):
            for w, sign in enumerate((plus, minus)):
                file.numbers((f"{r + 1}{sign}",), unit, error[r, w], 2)
    else:
        if layout == "long":
            forward, backward = rng.choice((("forward", "backward"), ("+", "-"), ("vor", "zurück"), ("up", "down")))
            rng.shuffle(order)
            file.add(("Lauf", "Run"), "", [str(r + 1) for r, _, _ in order])
            file.add(("Richtung", "Direction"), "", [backward if w else forward for _, w, _ in order])
        at = np.array([positions[t] for _, _, t in order])
        values = np.array([error[key] for key in order])
        if layout == "actual":  # both columns have one unit
            file.numbers(("Soll", "Target", "Sollposition"), "mm", at, 2)
            file.numbers(("Ist", "Actual", "Istposition"), "mm", at + values * 1e-3, 5)
        else:
            file.numbers(names, "mm", at, 2)
            file.numbers(deviations, unit, values, 2)
    file.write(path)
    truth = {"target_position": positions * 1e-3, "deviation": error * 1e-6}
    return answers | {"raw": "errormotion.raw.linear_positioning/1, targets"}, truth


def lengths(rng: random.Random, path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Write the lengths of a tracker: a row for each, or a column for each station."""
    file, stations, points = File(rng), rng.randint(3, 5), rng.randint(4, 20)
    length = np.array([[rng.uniform(500, 3000) for _ in range(points)] for _ in range(stations)]).round(4)
    at = np.array([[rng.uniform(0, 800) for _ in range(3)] for _ in range(points)]).round(2)
    answers = {"values.displacement_noise": "0.5 um", "raw": "errormotion.raw.multilateration/1"}
    answers |= {"units.displacement": "mm", "units.target_nominal": "mm"}
    prefix = rng.choice(("", "Target "))
    if rng.random() < 0.6:
        rows = [(s, p) for s in range(stations) for p in range(points)]
        file.add(("Station", "Standort", "Setup"), "", [f"S{s}" for s, _ in rows])
        file.add(("Punkt", "Target", "Point"), "", [f"P{p}" for _, p in rows])
        for k, axis in enumerate("XYZ"):
            file.numbers((prefix + axis,), "mm", np.array([at[p, k] for _, p in rows]), 2)
        file.numbers(("Länge", "Distance", "Length", "Abstand"), "mm", np.array([length[row] for row in rows]), 4)
    else:
        file.add(("Punkt", "Target", "Point"), "", [f"P{p}" for p in range(points)])
        for k, axis in enumerate("XYZ"):
            file.numbers((prefix + axis,), "mm", at[:, k], 2)
        for s in range(stations):
            file.numbers((f"S{s}",), "mm", length[s], 4)
    file.write(path)
    return answers, {"target_nominal": at * 1e-3, "displacement": length * 1e-3}


def thermometers(rng: random.Random, path: Path) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """Write a log of temperatures."""
    file, n = File(rng), rng.randint(5, 60)
    answers = {"units.temperature": "degC", "raw": "errormotion.raw.monitor/1"}
    truth = {"time": clock(rng, file, n, answers)}
    names = rng.sample(
        ("T1", "T2", "T Spindel", "Temp 3", "PT100 Bett", "Ständer Temperatur", "T Luft"), rng.randint(1, 5)
    )
    found = [file.numbers((name,), "°C", 20 + np.array([rng.random() for _ in range(n)]), 2)[1] for name in names]
    file.write(path)
    return answers, truth | {"temperature": np.stack(found, axis=1)}


@pytest.mark.slow
@pytest.mark.parametrize("written", [drift, positioning, lengths, thermometers])
@pytest.mark.parametrize("person", [True, False], ids=["answered", "proposals"])
def test_random_files_are_read_rightly_or_asked_for(tmp_path: Path, written, person: bool) -> None:
    """With the answers of a person, and with what is proposed where nothing is left open."""
    read = 0
    for seed in range(FILES):
        path, map_file = tmp_path / f"{seed}.csv", tmp_path / f"{seed}.toml"
        answers, truth = written(random.Random(seed), path)
        try:
            proposal = propose([path])
            if not person:  # what no file says
                answers = {key: text for key, text in answers.items() if key.startswith(("values", "attributes"))}
            while proposal.questions:
                question = proposal.questions[0]
                proposal = proposal.answered({question.key: answers.get(question.key, question.proposed)})
            write_map(proposal, map_file)
            raw = import_files([path], map_file)
        except DatasetError:
            continue
        read += 1
        for name, expected in truth.items():
            found = raw[name].squeeze("freedom", drop=True) if "freedom" in raw[name].dims else raw[name]
            if "approach" in found.dims:  # labels in the order of their first rows
                found = found.isel(approach=np.argsort(raw["approach"].values == "backward"))
            if "run" in found.dims:
                found = found.isel(run=np.argsort(raw["run"].values.astype(int)))
            if "target_position" in raw:
                found = found.isel(target=np.argsort(raw["target_position"].values))
            order = ("channel", "station", "time", "run", "approach", "target", "sensor", "direction")
            found = found.transpose(*(dim for dim in order if dim in found.dims))
            np.testing.assert_allclose(found.values, expected, rtol=1e-6, atol=6e-9, err_msg=f"{seed} {name}")
    assert read >= (READ if person else PROPOSED) * FILES


@pytest.mark.slow
def test_damaged_files_are_proposed_or_refused(tmp_path: Path) -> None:
    """Changed, cut and repeated bytes: no error but that of the package."""
    path = tmp_path / "file.csv"
    for seed in range(FILES):
        rng = random.Random(seed)
        rng.choice((drift, positioning, lengths, thermometers))(rng, path)
        data = bytearray(path.read_bytes())
        for _ in range(rng.randint(1, 12)):
            k = rng.randrange(len(data))
            data[k : k + rng.choice((0, 1, 20))] = rng.choice((b"", b";", data[rng.randrange(len(data)) :][:30]))
        path.write_bytes(data)
        try:
            proposal = propose([path])
            while proposal.questions:
                question = proposal.questions[0]
                first = question.choices[0].value if question.choices else ""
                proposal = proposal.answered({question.key: question.proposed or first})
            text_of(proposal)
        except DatasetError:
            continue
