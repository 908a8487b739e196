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

    def is_larger(chunk: int) -> bool:
        mask, packed = variable.id.read_direct_chunk(variable.id.get_chunk_info(chunk).chunk_offset)
        if mask & 1 << place:  # this chunk is plain
            return bool(len(packed) > most)
        return bool(len(zlib.decompressobj().decompress(packed, most + 1)) > most)

    count = variable.id.get_num_chunks()
    with ThreadPoolExecutor(min(cores(), max(count, 1)), thread_name_prefix="chunk") as pool:
        try:
            if any(pool.map(is_larger, range(count))):
                yield f"expected chunks of at most {most} bytes; found one that contains more"
        except zlib.error as error:
            yield f"a compressed chunk is damaged ({error}): copy the file again"


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
            if _refers(variable.id.get_type()):
                found = self._lengths(variable)
                exact += found or 0
                references += math.prod(variable.shape or ()) if found is None else 0
        if exact + references * self.size <= most:
            return exact + references * self.size
        return exact + references * self._largest()

    def _lengths(self, variable: h5py.Dataset) -> int | None:
        """Return the bytes that the references of a variable state; None where they are compressed or in its header."""
        addresses, _ = self.file.id.get_create_plist().get_sizes()
        properties = variable.id.get_create_plist()
        if properties.get_nfilters() or properties.get_layout() == h5py.h5d.COMPACT:
            return None
        reference = np.dtype([("length", "<u4"), ("address", f"V{addresses}"), ("index", "<u4")])
        unit = variable.id.get_type()
        width = unit.get_super().get_size() if unit.get_class() == h5py.h5t.VLEN else 1
        if variable.chunks:
            places = (variable.id.get_chunk_info(k) for k in range(variable.id.get_num_chunks()))
            pieces = [variable.id.read_direct_chunk(each.chunk_offset)[1] for each in places]
        elif variable.id.get_offset() is None:
            return 0  # nothing was written
        else:
            with self.path.open("rb") as file:
                file.seek(variable.id.get_offset())
                pieces = [file.read(variable.id.get_storage_size())]
        stated = [
            np.frombuffer(each[: len(each) // reference.itemsize * reference.itemsize], reference) for each in pieces
        ]
        return sum(int(each["length"].sum(dtype=np.uint64)) for each in stated) * width

    def _largest(self) -> int:
        """Return the size of the largest object of the heaps, bytes; every heap has a signature."""
        _, lengths = self.file.id.get_create_plist().get_sizes()
        largest = 0
        with self.path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            at = content.find(_HEAP)
            while at >= 0:
                largest = max(largest, _largest_object(content, at, lengths))
                at = content.find(_HEAP, at + len(_HEAP))
        return largest


def _largest_object(content: mmap.mmap, at: int, lengths: int) -> int:
    """Return the size of the largest object of a collection that begins at a place of a file."""
    end = min(len(content), at + int.from_bytes(content[at + 8 : at + 8 + lengths], "little"))
    place, largest = at + 8 + lengths, 0
    while place + 8 + lengths <= end:
        index = int.from_bytes(content[place : place + 2], "little")
        size = int.from_bytes(content[place + 8 : place + 8 + lengths], "little")
        if index == 0 or place + 8 + lengths + size > end:  # the free space is the last object
            break
        largest = max(largest, size)
        place += 8 + lengths + -(-size // 8) * 8
    return largest


def _refers(kind: Any) -> bool:
    """Return whether values of a type of HDF5 are references to a heap, or contain such."""
    if kind.get_class() == h5py.h5t.STRING:
        return bool(kind.is_variable_str())
    return kind.get_class() in (h5py.h5t.VLEN, h5py.h5t.COMPOUND, h5py.h5t.ARRAY)


def _in_attributes(owner: h5py.File | h5py.Dataset) -> int:
    """Return the number of references to a heap in the attributes of an object."""
    found = 0
    for k in range(h5py.h5a.get_num_attrs(owner.id)):
        attribute = h5py.h5a.open(owner.id, index=k)
        if _refers(attribute.get_type()):
            found += math.prod(attribute.shape)
    return found
