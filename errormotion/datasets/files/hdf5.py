"""What a NetCDF-4 file contains in fact, beside what it states: its texts, and its compressed chunks.

A text is stored as a reference of 16 bytes to an object of a heap. Many references may name one object, so that a
file of a megabyte states gigabytes of texts. A compressed chunk may contain a thousand times more than a chunk has,
which the library HDF5 decompresses to the end. Both are measured here without reading them.
"""

from __future__ import annotations

import math
import mmap
import zlib
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py  # type: ignore[import-untyped]
import numpy as np

from errormotion.datasets.files.hashing import cores

_HEAP = b"GCOL"
"""Begin of a collection of heap objects (HDF5 File Format Specification 3.0, III.E)."""
_DEFLATE, _SHUFFLE, _CHECKSUM = h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32
_CHECKSUM_BYTES = 4
_HEAD = 12
"""Least bytes of the head of an object of a heap."""
WIDTH = np.dtype("U1").itemsize
"""Bytes of a character in memory."""
_PLAIN = (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.ENUM, h5py.h5t.STRING)
"""Classes of numbers, truth values and texts."""
_OF_DIMENSIONS = {b"DIMENSION_LIST": h5py.h5t.VLEN, b"REFERENCE_LIST": h5py.h5t.COMPOUND}
"""Attributes that link variables to their dimensions, and the classes of their references."""


def wrong_types(owner: h5py.File | h5py.Dataset) -> Iterator[str]:
    """Yield a violation if a variable or an attribute of an object contains neither numbers nor texts.

    A value of another type may contain any number of others, so that sizes do not follow from the number of values.
    """
    if isinstance(owner, h5py.Dataset) and owner.id.get_type().get_class() not in _PLAIN:
        yield "expected numbers or texts; found a compound, a list of variable length or another type of HDF5"
    for name, attribute in _attributes(owner):
        kind = attribute.get_type()
        linking = kind.get_class() == _OF_DIMENSIONS.get(name) and not kind.detect_class(h5py.h5t.STRING)
        if not (kind.get_class() in _PLAIN or linking):
            yield f"attribute {name.decode(errors='replace')!r:.100}: expected numbers or texts; found another type"
            return


def violations(variable: h5py.Dataset) -> Iterator[str]:
    """Yield the violations in the compressed chunks of a variable."""
    properties = variable.id.get_create_plist()
    filters = [int(properties.get_filter(k)[0]) for k in range(properties.get_nfilters())]
    unknown = sorted({*filters} - {_DEFLATE, _SHUFFLE, _CHECKSUM})
    if unknown:
        yield f"expected values that are plain or compressed by deflate; found the filters {unknown} of HDF5"
    elif filters.count(_DEFLATE) > 1:
        yield "expected values that are compressed once"
    elif _DEFLATE in filters and {*filters[filters.index(_DEFLATE) + 1 :]} - {_CHECKSUM}:
        yield "expected values that are compressed after they are shuffled"
    elif _DEFLATE in filters:
        yield from _oversized(variable, filters)


def _oversized(variable: h5py.Dataset, filters: list[int]) -> Iterator[str]:
    """Yield a violation if a chunk contains more than the values of a chunk."""
    most = math.prod(variable.chunks) * variable.id.get_type().get_size() + _CHECKSUM_BYTES * len(filters)
    place = filters.index(_DEFLATE)

    def is_larger(chunk: tuple[int, ...]) -> bool:
        mask, packed = variable.id.read_direct_chunk(chunk)
        if mask & 1 << place:  # this chunk is plain
            return bool(len(packed) > most)
        return bool(len(zlib.decompressobj().decompress(packed, most + 1)) > most)

    def one_is_larger(chunks: list[tuple[int, ...]]) -> bool:
        return any(map(is_larger, chunks))

    chunks = _chunks(variable)
    threads = min(cores(), max(len(chunks), 1))
    with ThreadPoolExecutor(threads, thread_name_prefix="chunk") as pool:
        try:
            if any(pool.map(one_is_larger, [chunks[k::threads] for k in range(threads)])):
                yield f"expected chunks of at most {most} bytes; found one that contains more"
        except zlib.error as error:
            yield f"a compressed chunk is damaged ({error}): copy the file again"


def _chunks(variable: h5py.Dataset) -> list[tuple[int, ...]]:
    """Return the places of all chunks in one pass; HDF5 looks up a chunk by its number in a time that grows with it."""
    places: list[tuple[int, ...]] = []
    if variable.id.get_num_chunks():
        variable.id.chunk_iter(lambda each: places.append(each.chunk_offset))
    return places


@dataclass(frozen=True)
class Stored:
    """The texts of a file.

    Attributes
    ----------
    path : Path
    size : int
        Of the file, bytes.
    file : h5py.File
    """

    path: Path
    size: int
    file: h5py.File

    def texts(self, variables: Iterable[h5py.Dataset], most: int) -> int:
        """Return an upper limit of the bytes of all texts of the file, in variables and attributes.

        No text is longer than the file, nor than the largest object of its heap, which is looked for only where the
        first limit is not below ``most``.
        """
        exact, references = 0, _in_attributes(self.file)
        for variable in variables:
            references += _in_attributes(variable)
            if is_text(variable):
                lengths = self._lengths(variable)
                exact += lengths or 0
                references += math.prod(variable.shape or ()) if lengths is None else 0
        if exact + WIDTH * references * self.size <= most:
            return exact + WIDTH * references * self.size
        return exact + WIDTH * references * self._largest()

    def _lengths(self, variable: h5py.Dataset) -> int | None:
        """Return the bytes of the texts of a variable in memory, where each has the width of the longest one.

        None where the references are compressed or in its header.
        """
        addresses, _ = self.file.id.get_create_plist().get_sizes()
        properties = variable.id.get_create_plist()
        if properties.get_nfilters() or properties.get_layout() == h5py.h5d.COMPACT:
            return None
        reference = np.dtype([("length", "<u4"), ("address", f"V{addresses}"), ("index", "<u4")])
        if variable.chunks:
            pieces = [variable.id.read_direct_chunk(each)[1] for each in _chunks(variable)]
        elif variable.id.get_offset() is None:
            return 0  # nothing was written
        else:
            with self.path.open("rb") as file:
                file.seek(variable.id.get_offset())
                pieces = [file.read(variable.id.get_storage_size())]
        stated = [
            np.frombuffer(each[: len(each) // reference.itemsize * reference.itemsize], reference) for each in pieces
        ]
        longest = max((int(each["length"].max(initial=0)) for each in stated), default=0)
        return WIDTH * math.prod(variable.shape or ()) * longest

    def _largest(self) -> int:
        """Return the size of the largest object of the heaps, bytes; every heap has a signature.

        Heaps do not overlap, and an object has a head. Where more objects are found, the heaps are forged,
        and the limit is the size of the file.
        """
        _, lengths = self.file.id.get_create_plist().get_sizes()
        largest, left = 0, self.size // _HEAD + 1
        with self.path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            at = content.find(_HEAP)
            while at >= 0:
                size, count = _largest_object(content, at, lengths)
                largest, left = max(largest, size), left - count
                if left < 0:
                    return self.size
                at = content.find(_HEAP, at + len(_HEAP))
        return largest


def _largest_object(content: mmap.mmap, at: int, lengths: int) -> tuple[int, int]:
    """Return the size of the largest object of a collection that begins at a place of a file, and their number."""
    end = min(len(content), at + int.from_bytes(content[at + 8 : at + 8 + lengths], "little"))
    place, largest, count = at + 8 + lengths, 0, 0
    while place + 8 + lengths <= end:
        index = int.from_bytes(content[place : place + 2], "little")
        size = int.from_bytes(content[place + 8 : place + 8 + lengths], "little")
        if index == 0 or place + 8 + lengths + size > end:  # the free space is the last object
            break
        largest, count = max(largest, size), count + 1
        place += 8 + lengths + -(-size // 8) * 8
    return largest, count


def is_text(owner: Any) -> bool:
    """Return whether the values of a variable or an attribute are references to texts in a heap."""
    kind = (owner.id if isinstance(owner, h5py.Dataset) else owner).get_type()
    return bool(kind.get_class() == h5py.h5t.STRING and kind.is_variable_str())


def _in_attributes(owner: h5py.File | h5py.Dataset) -> int:
    """Return the number of references to a heap in the attributes of an object."""
    return sum(math.prod(each.shape) for name, each in _attributes(owner) if name in _OF_DIMENSIONS or is_text(each))


def _attributes(owner: h5py.File | h5py.Dataset) -> Iterator[tuple[bytes, Any]]:
    """Yield name and attribute, by name: HDF5 sorts all attributes again for each one that is opened by its number."""
    names: list[bytes] = []
    h5py.h5a.iterate(owner.id, names.append)
    for name in names:
        yield name, h5py.h5a.open(owner.id, name)
