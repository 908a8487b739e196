"""Golden vectors: bytes of a protocol with their meaning and their published source, in tests/data/vectors."""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

FOLDER = Path(__file__).parents[1] / "data" / "vectors"
KINDS = ("published", "peer", "derived")


@dataclass(frozen=True)
class Vector:
    """One row of a file of vectors.

    ``kind`` is ``published`` (the document prints these bytes), ``peer`` (an independent implementation sent them) or
    ``derived`` (worked out by hand from a formula or table that the document prints). ``layer`` says which part of the
    codec it is for; ``data`` are the bytes, ``expected`` their meaning.
    """

    name: str
    source: str
    kind: Literal["published", "peer", "derived"]
    layer: str
    data: bytes
    expected: dict[str, Any]

    def __str__(self) -> str:
        return self.name


def vectors(device: str, layer: str | None = None) -> list[Vector]:
    """Return the vectors of a device, in order; of one layer where it is given. An empty list is an error."""
    rows = tomllib.loads((FOLDER / f"{device}.toml").read_text(encoding="utf-8"))["vector"]
    found = [_vector(row) for row in rows]
    chosen = [vector for vector in found if layer in (None, vector.layer)]
    assert chosen, f"{device} has no vectors of layer {layer}"
    return chosen


def _vector(row: dict[str, Any]) -> Vector:
    given = dict(row)
    data = bytes.fromhex(given.pop("bytes")) if "bytes" in given else given.pop("text").encode("latin-1")
    return Vector(data=data, **given)
