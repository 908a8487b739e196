"""The hash of the names, attributes and values of a dataset, independent of the file format.

The form ``blake3-tree`` is a BLAKE3 hash over, in this order,

* ``["attributes", {...}]``, as a line of JSON with sorted keys;
* for each variable, sorted by name: ``[name, dims, shape, type, attributes]``, as such a line, then the BLAKE3 digests
  of its leaves, 32 bytes each.

A leaf is a run of values in C order, little-endian, with one bit pattern for NaN. The last axes that together have at
most `LEAF` values are not divided, the axis before them is divided into pieces of as many indices as fit, and each
index of the axes before that one has separate leaves. Texts are one leaf: a JSON list.

Leaves are hashed in parallel threads, in any order, from parts that are read once. Two forms of earlier versions
are supported to compare a dataset with a stored hash: ``sha256-tree``, the same with SHA-256, and ``sha256``,
one SHA-256 over all values in turn.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock
from typing import Any, Self

import numpy as np
import xarray as xr
from blake3 import blake3
from pydantic import BaseModel
from xarray.indexes import RangeIndex

from errormotion.errors import DatasetError

LEAF = 2**16
"""Largest number of values of one leaf; part of the form's definition."""

_TREES: dict[str, Any] = {"blake3-tree": blake3, "sha256-tree": hashlib.sha256}
_FORMS = (*_TREES, "sha256")
_TILE = 2**25  # bytes read at a time
_PENDING = 2**26  # largest number of bytes in the queue
_TASK = 2**21  # bytes of one task of a thread
_SMALL = 2**16  # bytes that are hashed sooner than another thread takes them over
_FIRST_FORM_BLOCK = 2**21  # values; part of the definition of the form "sha256"


def plain(value: Any) -> Any:
    """Return a value with the types of JSON; numbers that are not finite are converted to text."""
    if isinstance(value, BaseModel):
        return plain(value.model_dump(mode="json"))
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def hash_dataset(ds: xr.Dataset, form: str = "blake3-tree") -> str:
    """Return the hash of a dataset's names, dimensions, attributes and values.

    The required memory does not depend on the size of the dataset; the hash does not depend on file format, chunks,
    byte order and the width of texts. Evenly spaced times that follow from the attributes ``sample_rate`` and
    ``time_start`` are not read.

    Parameters
    ----------
    ds : Dataset
    form : str
        ``blake3-tree``; or ``sha256-tree`` or ``sha256``, the forms of earlier versions.

    Returns
    -------
    str
        ``form:digest``, the digest in hexadecimal digits.

    Raises
    ------
    DatasetError
        The form is unknown.
    """
    if form == "sha256":
        return _first_form(ds)
    if form not in _FORMS:
        raise DatasetError(
            f"The form of hash '{form}' is unknown; expected one of {', '.join(_FORMS)}", code="hash.form.unknown"
        )
    with DatasetHasher(ds, form) as hasher:
        return hasher.value()


def has_hash(ds: xr.Dataset, stored: str) -> bool:
    """Return whether a dataset has a stored hash of any form."""
    form = stored.partition(":")[0]
    return form in _FORMS and hash_dataset(ds, form) == stored


class DatasetHasher:
    """The hash of a dataset in the form of a tree, from parts that are read for another purpose.

    `value` reads parts that were not passed. To be used as a context manager.
    """

    def __init__(self, ds: xr.Dataset, form: str = "blake3-tree") -> None:
        self._ds, self._form, self._new = ds, form, _TREES[form]
        self._pool = ThreadPoolExecutor(cores(), thread_name_prefix="hash")
        self._queue: deque[tuple[Future[None], int]] = deque()
        self._pending = 0
        self._leaves: dict[str, _Leaves] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def update(self, name: str, values: np.ndarray, **window: slice) -> None:
        """Hash a part of a variable in this thread; several threads may hand over parts, in any order.

        Parameters
        ----------
        name : str
        values : ndarray
            With the axes of the variable; must not be changed afterwards.
        **window : slice
            Indices of the part along the dimensions that are not complete.
        """
        variable = self._ds.variables[name]
        leaves = self._leaves.get(name) or self._leaves.setdefault(name, _Leaves(variable))
        starts = [(window[str(dim)].start if str(dim) in window else 0) for dim in variable.dims]
        if leaves.accepts(values.shape):
            for runs, out in leaves.take(starts, values):
                _hash_leaves(runs, leaves.piece, out, self._new)

    def value(self) -> str:
        """Return ``form:digest``; reads parts that were not passed."""
        digest = self._new(_line("attributes", _canonical(self._ds.attrs)))
        for name in sorted(map(str, self._ds.variables)):
            if isinstance(self._ds.xindexes.get(name), RangeIndex):
                continue
            variable = self._ds.variables[name]
            digest.update(_header(name, variable))
            if _is_text(variable):
                digest.update(self._new(_texts(variable)).digest())
                continue
            leaves = self._leaves.get(name) or _Leaves(variable)
            if not leaves.complete:
                leaves = self._read(variable)
            self._wait(0)
            digest.update(leaves.digests.tobytes())
        return f"{self._form}:{digest.hexdigest()}"

    def _read(self, variable: xr.Variable) -> _Leaves:
        leaves = _Leaves(variable)
        for window in _tiles(variable, leaves.axis):
            values = np.asarray(variable[window].values)
            self._hash(leaves, [each.start for each in window], values)
        return leaves

    def _hash(self, leaves: _Leaves, starts: Sequence[int], values: np.ndarray) -> None:
        self._wait(_PENDING - values.nbytes)
        for runs, out in leaves.take(starts, values):
            size = sum(run.nbytes for run in runs)
            if size <= _SMALL:
                _hash_leaves(runs, leaves.piece, out, self._new)
                continue
            self._queue.append((self._pool.submit(_hash_leaves, runs, leaves.piece, out, self._new), size))
            self._pending += size

    def _wait(self, most: int) -> None:
        """Wait until at most ``most`` bytes are pending."""
        while self._queue and self._pending > most:
            future, size = self._queue.popleft()
            future.result()
            self._pending -= size


class _Leaves:
    """The digests of one variable's leaves.

    The shape of the variable is (row, length, inner): ``inner`` values are not divided, ``length`` is divided into
    pieces.

    Attributes
    ----------
    axis : int
        The axis that is divided.
    piece : int
        Number of indices along it in a leaf.
    digests : ndarray, uint8, (row, leaf, 32)
    """

    def __init__(self, variable: xr.Variable) -> None:
        self.shape = (1, *variable.shape)  # at least one axis to divide
        axis, inner = len(self.shape) - 1, 1
        while axis > 0 and inner * self.shape[axis] <= LEAF:
            inner *= self.shape[axis]
            axis -= 1
        self._axis, self._inner = axis, max(inner, 1)
        self.axis = max(axis - 1, 0)
        self.piece = LEAF // self._inner
        self._length = self.shape[axis] if inner else 0
        self._rows = np.arange(math.prod(self.shape[:axis])).reshape(self.shape[:axis])
        self.digests = np.empty((self._rows.size, -(-self._length // self.piece), 32), np.uint8)
        self._done = np.zeros(self.digests.shape[:2], bool)
        self._open: dict[tuple[int, int], dict[int, np.ndarray]] = {}
        self._lock = Lock()

    @property
    def complete(self) -> bool:
        return bool(self._done.all())

    def accepts(self, shape: Sequence[int]) -> bool:
        """Return whether a part has complete inner axes."""
        return self.shape[self._axis + 1 :] == (1, *shape)[self._axis + 1 :]

    def take(self, starts: Sequence[int], values: np.ndarray) -> Iterator[tuple[list[np.ndarray], np.ndarray]]:
        """Yield the values of complete leaves with the digests to fill; keep an incomplete leaf until the rest arrives.

        The values are one run of several leaves, or several runs of one leaf.
        """
        starts, shape = (0, *starts), (1, *values.shape)
        start, count = starts[self._axis], shape[self._axis]
        block = values.reshape(-1, count, *values.shape[self._axis :])
        for row, run in zip(self._within(starts, shape).ravel().tolist(), block, strict=True):
            first = min(-start % self.piece, count)
            last = first + (count - first) // self.piece * self.piece
            yield from self._part(row, start, run[:first])
            step = max(1, _TASK // (self.piece * self._inner * values.itemsize)) * self.piece
            for k in range(first, last, step):
                task = run[k : min(k + step, last)]
                leaves = slice((start + k) // self.piece, (start + k + len(task)) // self.piece)
                self._done[row, leaves] = True
                yield [task], self.digests[row, leaves]
            yield from self._part(row, start + last, run[last:])

    def _part(self, row: int, start: int, values: np.ndarray) -> Iterator[tuple[list[np.ndarray], np.ndarray]]:
        """Yield the runs of a leaf when they are all there."""
        if not len(values):
            return
        leaf = start // self.piece
        with self._lock:
            parts = self._open.setdefault((row, leaf), {})
            parts[start] = values
            end = leaf * self.piece
            for begin in sorted(parts):
                end = end + len(parts[begin]) if begin == end else -1
            if end != min((leaf + 1) * self.piece, self._length):
                return
            del self._open[row, leaf]
        self._done[row, leaf] = True
        yield [parts[begin] for begin in sorted(parts)], self.digests[row, leaf : leaf + 1]

    def _within(self, starts: Sequence[int], shape: Sequence[int]) -> np.ndarray:
        """Return the numbers of the rows of a part."""
        window = tuple(slice(a, a + n) for a, n in zip(starts, shape, strict=True))
        return np.asarray(self._rows[window[: self._axis]])


def _hash_leaves(runs: list[np.ndarray], piece: int, out: np.ndarray, new: Any) -> None:
    if len(runs) == 1:
        content, size = _bytes(runs[0]), piece * runs[0][:1].nbytes
        digests = [new(content[k * size : (k + 1) * size]).digest() for k in range(len(out))]
        out[...] = np.frombuffer(b"".join(digests), np.uint8).reshape(out.shape)
        return
    digest = new()
    for run in runs:
        digest.update(_bytes(run))
    out[0] = np.frombuffer(digest.digest(), np.uint8)


def _tiles(variable: xr.Variable, axis: int) -> Iterator[tuple[slice, ...]]:
    """Yield windows over a variable, of some tens of megabytes of complete chunks; axes after ``axis`` are complete."""
    stored = variable.chunksizes or variable.encoding.get("preferred_chunks") or {}
    lengths = [stored.get(dim, 1) for dim in variable.dims]
    chunk = [max(1, length[0] if isinstance(length, tuple) else int(length)) for length in lengths]
    whole = tuple(slice(0, n) for n in variable.shape)

    def divided(window: tuple[slice, ...]) -> Iterator[tuple[slice, ...]]:
        sizes = [each.stop - each.start for each in window]
        counts = [-(-sizes[k] // chunk[k]) for k in range(axis + 1)] if sizes else [1]
        along = int(np.argmax(counts))
        size = math.prod(sizes) * variable.dtype.itemsize
        if size <= _TILE or counts[along] == 1:
            yield window
            return
        step = max(1, _TILE * counts[along] // size) * chunk[along]
        for start in range(window[along].start, window[along].stop, step):
            part = slice(start, min(start + step, window[along].stop))
            yield from divided((*window[:along], part, *window[along + 1 :]))

    yield from divided(whole)


def cores() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _line(*parts: Any) -> bytes:
    return json.dumps(parts, sort_keys=True).encode() + b"\n"


def _header(name: str, variable: xr.Variable) -> bytes:
    kind = "text" if _is_text(variable) else variable.dtype.newbyteorder("<").str
    return _line(name, list(map(str, variable.dims)), list(variable.shape), kind, _canonical(variable.attrs))


def _canonical(attrs: Mapping[Any, Any]) -> Any:
    """Return attributes in the form after a NetCDF round trip: arrays of one element are numbers."""
    return {
        name: value[0] if isinstance(value, list) and len(value) == 1 else value for name, value in plain(attrs).items()
    }


def _is_text(variable: xr.Variable) -> bool:
    return variable.dtype.kind in "OSTU"


def _texts(variable: xr.Variable) -> bytes:
    texts = np.asarray(variable.values).ravel().tolist()
    return json.dumps([text.decode() if isinstance(text, bytes) else str(text) for text in texts]).encode()


def _bytes(values: np.ndarray) -> memoryview:
    """Return values as bytes: C order, little-endian, NaN with one bit pattern; copied only if necessary."""
    values = np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("<"))
    # The maximum is NaN if one of the values is, and is faster than a search for NaN.
    if values.dtype.kind == "f" and np.isnan(values.max(initial=-np.inf)):
        values = np.where(np.isnan(values), values.dtype.type(np.nan), values)
    return values.reshape(-1).view(np.uint8).data


def _first_form(ds: xr.Dataset) -> str:
    digest = hashlib.sha256(_line("attributes", _canonical(ds.attrs)))
    for name in sorted(map(str, ds.variables)):
        if isinstance(ds.xindexes.get(name), RangeIndex):
            continue
        variable = ds.variables[name]
        digest.update(_header(name, variable))
        for block in [_texts(variable)] if _is_text(variable) else _first_form_blocks(variable):
            digest.update(block)
    return f"sha256:{digest.hexdigest()}"


def _first_form_blocks(variable: xr.Variable) -> Iterator[memoryview]:
    """Yield the values in blocks that depend on the shape only: two dimensions at a time, along the longer one."""
    if variable.ndim == 0 or variable.size <= _FIRST_FORM_BLOCK:
        yield _bytes(np.asarray(variable.values))
        return
    for index in np.ndindex(*variable.shape[:-2]):
        part = variable[index]
        longest = max(part.sizes, key=lambda dim: part.sizes[dim])
        size = part.sizes[longest]
        length = max(1, _FIRST_FORM_BLOCK * size // part.size)
        for start in range(0, size, length):
            yield _bytes(np.asarray(part.isel({longest: slice(start, start + length)}).values))
