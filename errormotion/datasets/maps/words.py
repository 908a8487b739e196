"""Names of quantities in the files of laboratories, English and German: what a title of a column says."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache

from errormotion.datasets.tables.table import name_of, same
from errormotion.datasets.text.layout import BACKWARD, FORWARD

_SYNONYMS = """
time: zeit t datum date uhrzeit timestamp zeitstempel elapsed zeitpunkt stunden minuten sekunden datetime datumzeit
temperature: temp temperatur temperaturen pt thermometer fühler tc therm thermoelement t temps
speed: drehzahl rpm n spindeldrehzahl geschwindigkeit upm
spindle: spindel
position: pos stellung ort
target: soll ziel sollposition targets nominal sollwert zielposition point punkt zielpunkt commanded nom
actual: ist istposition istwert actual measured gemessen messwert act meas
deviation: abweichung fehler error err dev abw abweichungen errors positionsabweichung
distance: abstand distanz dist weg sensor kanal channel ch probe messwert reading taster cap
displacement: verschiebung weg sensor distanz displ length länge distance abstand kanal channel ch probe reading taster
length: länge laenge distanz distance displacement radius
angle: winkel drehwinkel phi grad azimut
pressure: druck luftdruck p
humidity: feuchte luftfeuchte rh hum feuchtigkeit rf
air: luft lufttemperatur luftdruck luftfeuchte
feed: vorschub
load: last auslastung
station: setup standort aufstellung stationen stand aufbau
run: lauf zyklus durchgang messreihe wiederholung cycle runs repeat messlauf
approach: richtung direction anfahrrichtung dir way anfahrt
plane: ebene fläche
sensor: taster fühler kanal probe
centre: center mittelpunkt zentrum mitte
radius: halbmesser
reading: messwert ablesung wert
reference: referenz
inclination: neigung
rotation: drehung
stage: tisch
nominal: soll nom target sollwert ziel
"""
SYNONYMS = {
    word: frozenset([word, *others.split()])
    for word, _, others in (line.partition(":") for line in _SYNONYMS.strip().splitlines())
}
"""Words of titles by a word of the names of variables and dimensions."""

_FORWARD = """
forward forwards fwd + vor vorwärts hin up pos positiv positive increasing v f auf plus
"""
_BACKWARD = """
backward backwards bwd bck - – zurück rück rückwärts zurueck her down neg negativ negative decreasing
reverse rev r b z ab minus
"""
_UNMISTAKABLE = """
forward forwards fwd vorwärts hin increasing backward backwards bwd bck zurück zurueck rück rückwärts decreasing reverse
"""
_CLEAR_WAYS = frozenset(_UNMISTAKABLE.split())
"""Words for a direction that have no other meaning in a title, unlike ``r`` or a hyphen."""
WAYS = {FORWARD: frozenset(_FORWARD.split()), BACKWARD: frozenset(_BACKWARD.split())}
"""Words for the directions in which a target is approached."""
_PROPERTIES = """
uncertainty unsicherheit standardabw stdabw stddev stdev correction korrektur compensation kompensation tolerance
toleranz umkehrspanne
"""
_NO_READINGS = tuple(_PROPERTIES.split())
_NO_READING = frozenset({"std", "sigma", "standard", "unc"})
"""Parts of words, and words, of what belongs to a quantity but is not its readings."""
_POSITIONING = "position|pos|ist|soll|target|actual|nominal|linear|abw|abweichung|deviation|dev|fehler|error|err"
_FILLERS = """
run lauf zyklus cycle messung messlauf messreihe achse axis der die of in the
"""
_FILLING = frozenset(_FILLERS.split())
_COMPOSED = re.compile(f"(?:(?:{_POSITIONING})(?:en|s)?)+")
_OTHER_ERRORS = re.compile(
    r"gerad|straight|rechtwink|squareness|winkel|angular|angle|pitch|yaw|roll|nick|gier|wank|parallel|ebenheit|flatness",
    re.IGNORECASE,
)
_TOKEN = re.compile(r"[^\W\d_]+|[0-9]+|[+\-–]")


@lru_cache(maxsize=100_000)
def tokens(title: str) -> tuple[str, ...]:
    """Return the words and numbers of a title without its unit, in lower case."""
    return tuple(_TOKEN.findall(name_of(same(title)).lower()))


def words_of(name: str, further: Iterable[str] = ()) -> frozenset[str]:
    """Return the words that a title may have for a variable or dimension with this name."""
    parts = name.lower().split("_")
    found = frozenset[str]().union(*(SYNONYMS.get(part, frozenset([part])) for part in parts))
    return found | frozenset(further)


def likeness(title: str, name: str, further: Iterable[str] = ()) -> float:
    """Return how well a title fits the name of a variable or dimension: 0 (no common word) to 3 (the name)."""
    return _likeness(title, name, tuple(further))


@lru_cache(maxsize=100_000)
def _likeness(title: str, name: str, stated: tuple[str, ...]) -> float:
    own = tokens(title)
    if not own:
        return 0.0
    plain = "_".join(own)
    if plain == name.lower() or plain in {"_".join(_TOKEN.findall(each.lower())) for each in stated}:
        return 3.0
    letters = [token for token in own if not token.isdigit()]
    single = frozenset(each for each in stated if len(_TOKEN.findall(each)) == 1)
    # every part of the name counts: an air temperature is no spindle temperature
    parts = [SYNONYMS.get(part, frozenset([part])) for part in name.lower().split("_")]
    hits = sum(any(_says(token, words) for token in letters) for words in parts)
    if any(_says(token, single) for token in letters):
        return 2.5
    return 2.0 * hits / len(parts) if hits else 0.0


def _says(token: str, words: frozenset[str]) -> bool:
    """Return whether a word of a title is one of these, or composed with one of at least four letters."""
    return token in words or any(len(word) > 3 and (token.startswith(word) or token.endswith(word)) for word in words)


def way_of(text: str) -> str:
    """Return the direction of approach that a label or title states; empty if none."""
    own = tokens(text) or (text.strip().lower(),)
    found = {way for way, words in WAYS.items() for token in own if token in words}
    return found.pop() if len(found) == 1 else ""


def is_clear_way(token: str) -> bool:
    """Return whether a word of a title states a direction of approach and nothing else."""
    return token in _CLEAR_WAYS


def is_no_reading(title: str, name: str) -> bool:
    """Return whether a title states what belongs to a variable but is not its readings, such as its uncertainty."""
    if any(part in name for part in ("uncertainty", "correction", "compensation", "tolerance")):
        return False
    return any(token in _NO_READING or any(part in token for part in _NO_READINGS) for token in tokens(title))


def is_positioning(title: str, axis: str) -> bool:
    """Return whether a title has only words that a deviation along its own axis may have: no other axis or quantity."""
    own = axis.lower()
    others = set("xyzabcuvw") - {own}
    return all(
        token not in others
        and (
            token == own
            or token.isdigit()
            or token in _FILLING
            or any(token in words for words in WAYS.values())
            or _COMPOSED.fullmatch(token) is not None
        )
        for token in tokens(title)
    )


def states_other_errors(text: str) -> bool:
    """Return whether a line states errors other than positioning, such as straightness."""
    return _OTHER_ERRORS.search(text) is not None
