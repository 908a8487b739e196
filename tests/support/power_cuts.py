"""Power cuts: what may be on a disk after one, computed from the recorded writes of a program.

A `Recording` notes what happens in a folder: new content of files, changes of names, and flushes (``fsync``) of files
and of folders. A `Cut` makes a folder that a disk may contain if the power fails after one of these operations. POSIX
promises only what was flushed:

* the content of a file that was changed after its last flush may be old, new, between, or a mixture of sectors;
* a name that was created, renamed or removed after the last flush of its folder may be there or not, independently of
  other names. A rename itself is not divided.
"""

from __future__ import annotations

import os
import random
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SECTOR = 512
"""Bytes that a disk writes as one."""
_NAMES = ("rename", "replace", "unlink", "remove", "mkdir", "rmdir", "link", "symlink", "truncate", "ftruncate")
_FLUSHES = ("fsync", "fdatasync")


@dataclass(frozen=True)
class Content:
    """A file has a new content."""

    node: int
    data: bytes


@dataclass(frozen=True)
class Names:
    """Names of a folder change together; None: the name is removed."""

    folder: int
    changed: tuple[tuple[str, int | None], ...]


@dataclass(frozen=True)
class Flushed:
    """A file or folder is on the disk."""

    node: int


@dataclass(frozen=True)
class Committed:
    """The program states that something is on the disk."""

    what: Any


Operation = Content | Names | Flushed | Committed


@dataclass
class Recording:
    """The operations in a folder; `recorded` fills it.

    Attributes
    ----------
    operations : list
        In their order.
    folders : set of int
        Numbers of the nodes that are folders; 0 is the recorded folder.
    """

    folder: Path
    operations: list[Operation] = field(default_factory=list)
    folders: set[int] = field(default_factory=lambda: {0})
    _next: int = 1
    _lock: threading.RLock = field(default_factory=threading.RLock)
    _names: dict[int, dict[str, int]] = field(default_factory=lambda: {0: {}})
    _content: dict[int, bytes] = field(default_factory=dict)
    _inodes: dict[int, int] = field(default_factory=dict)
    _stamps: dict[int, tuple[int, int]] = field(default_factory=dict)
    _unflushed: set[int] = field(default_factory=set)

    def committed(self, what: Any) -> None:
        """Note that something is on the disk from now on."""
        with self._lock:
            self.scan()
            self.operations.append(Committed(what))

    def flushed(self, descriptor: int) -> None:
        """Note the flush of an open file or folder."""
        self.scan()
        node = self._inodes.get(os.fstat(descriptor).st_ino)
        if node is not None:
            self.operations.append(Flushed(node))
            self._unflushed.discard(node)

    def scan(self) -> None:
        """Note what has changed since the last scan."""
        found: dict[int, dict[str, int]] = {}
        inodes: dict[int, int] = {os.stat(self.folder).st_ino: 0}
        files: list[tuple[int, str, os.stat_result]] = []
        self._walk(self.folder, 0, found, inodes, files)
        self._inodes = inodes
        for node, path, state in files:
            stamp = (state.st_mtime_ns, state.st_size)
            # Two writes within a tick of the clock have the same time: what is not flushed is always compared.
            if node in self._unflushed or self._stamps.get(node) != stamp:
                self._stamps[node] = stamp
                with open(path, "rb") as file:
                    data = file.read()
                if self._content.get(node) != data:
                    self._content[node] = data
                    self.operations.append(Content(node, data))
                    self._unflushed.add(node)
        for node, names in found.items():
            before = self._names.get(node, {})
            changed = {
                name: names.get(name) for name in before.keys() | names.keys() if before.get(name) != names.get(name)
            }
            # A node that only changes its name is renamed, in one step.
            for name, target in sorted(changed.items(), key=lambda item: item[1] is None):
                if name not in changed:
                    continue
                old = [n for n, t in before.items() if t == target and n in changed and changed[n] is None]
                pairs = [(name, target), *((n, None) for n in old if target is not None)]
                self.operations.append(Names(node, tuple(pairs)))
                changed = {n: t for n, t in changed.items() if n not in dict(pairs)}
        self._names = found

    def _walk(
        self,
        folder: Path | str,
        node: int,
        found: dict[int, dict[str, int]],
        inodes: dict[int, int],
        files: list[tuple[int, str, os.stat_result]],
    ) -> None:
        names = found[node] = {}
        for each in sorted(os.scandir(folder), key=lambda entry: entry.name):
            state = each.stat(follow_symlinks=False)
            number = inodes.get(state.st_ino, self._inodes.get(state.st_ino))
            if number is None:
                number, self._next = self._next, self._next + 1
            inodes[state.st_ino] = names[each.name] = number
            if each.is_dir(follow_symlinks=False):
                self.folders.add(number)
                self._walk(each.path, number, found, inodes, files)
            else:
                files.append((number, each.path, state))


@contextmanager
def recorded(folder: Path) -> Iterator[Recording]:
    """Record what this process does in a folder, whose present content is taken as flushed."""
    recording = Recording(folder)
    recording.scan()
    flushes = [Flushed(node) for node in sorted({*recording.folders, *recording._content})]
    recording.operations += flushes
    recording._unflushed.clear()
    originals = {name: getattr(os, name) for name in (*_NAMES, *_FLUSHES)}

    def naming(original: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **keywords: Any) -> Any:
            with recording._lock:
                recording.scan()
                try:
                    return original(*arguments, **keywords)
                finally:
                    recording.scan()

        return call

    def flushing(original: Callable[..., Any]) -> Callable[..., Any]:
        def call(descriptor: Any) -> None:
            with recording._lock:
                original(descriptor)
                recording.flushed(descriptor if isinstance(descriptor, int) else descriptor.fileno())

        return call

    for name in _NAMES:
        setattr(os, name, naming(originals[name]))
    for name in _FLUSHES:
        setattr(os, name, flushing(originals[name]))
    try:
        yield recording
    finally:
        for name, original in originals.items():
            setattr(os, name, original)
        recording.scan()


class Cut:
    """The disk after a power cut.

    Parameters
    ----------
    recording : Recording
    after : int
        Number of operations that happened before.
    chance : Random
        Decides what of the unflushed changes is on the disk.

    Attributes
    ----------
    committed : list
        What the program has stated to be on the disk.
    """

    def __init__(self, recording: Recording, after: int, chance: random.Random) -> None:
        self.committed: list[Any] = []
        self._folders, self._chance = recording.folders, chance
        self._content: dict[int, list[bytes]] = {}
        self._names: dict[int, dict[str, int]] = {}
        pending: dict[int, list[Names]] = {}
        for each in recording.operations[:after]:
            if isinstance(each, Committed):
                self.committed.append(each.what)
            elif isinstance(each, Content):
                self._content.setdefault(each.node, [b""]).append(each.data)
            elif isinstance(each, Names):
                pending.setdefault(each.folder, []).append(each)
            elif each.node in self._folders:
                for change in pending.pop(each.node, []):
                    self._apply(change)
            elif each.node in self._content:
                self._content[each.node] = self._content[each.node][-1:]
        # Nothing unflushed is there; all of it (only the process was killed); the first changes; or any of them.
        self.kind = chance.choice(("none", "all", "first", "any", "any", "any"))
        for changes in pending.values():
            for change in self._some(changes):
                self._apply(change)

    def _some(self, changes: list[Names]) -> list[Names]:
        if self.kind == "first":
            return changes[: self._chance.randint(0, len(changes))]
        return [each for each in changes if self.kind == "all" or (self.kind == "any" and self._chance.random() < 0.5)]

    def _apply(self, change: Names) -> None:
        names = self._names.setdefault(change.folder, {})
        for name, node in change.changed:
            if node is None:
                names.pop(name, None)
            else:
                names[name] = node

    def write(self, folder: Path) -> None:
        """Write what is on the disk to a new folder."""
        self._write(folder, 0)

    def _write(self, path: Path, node: int) -> None:
        path.mkdir()
        for name, target in self._names.get(node, {}).items():
            if target in self._folders:
                self._write(path / name, target)
            else:
                (path / name).write_bytes(self._surviving(self._content.get(target, [b""])))

    def _surviving(self, versions: list[bytes]) -> bytes:
        """Return one content of a file from that of its last flush and all later ones."""
        if self.kind in ("none", "all") or len(versions) == 1:
            return versions[0 if self.kind == "none" else -1]
        if self._chance.random() < 0.5:
            return self._chance.choice(versions)
        # A mixture of sectors; what was never written is zero, and the size may be any between.
        sizes = [len(each) for each in versions]
        mixture = bytearray(self._chance.choice([*sizes, self._chance.randint(min(sizes), max(sizes))]))
        for start in range(0, len(mixture), SECTOR):
            piece = self._chance.choice(versions)[start : min(start + SECTOR, len(mixture))]
            mixture[start : start + len(piece)] = piece
        return bytes(mixture)
