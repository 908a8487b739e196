"""Exclusive use of devices: many accept one connection only, and offsets of a machine have one writer.

A program that measures or compensates claims the addresses of its devices before it opens them; a second one is
refused, and told who uses them. A program that only displays readings then closes the instruments, and reads the run
folder of the claim instead.

A claim is a locked file in a folder of the computer in which every user may lock; the operating system releases it when
its process ends for any reason. It has the hashes of the addresses, and states user, process, start, purpose and run
folder. Claims prevent mistakes; they do not protect against a user of the computer who wants to disturb.
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import os
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Literal
from uuid import uuid4

from errormotion.campaign.addresses import EXEMPT, is_line, same_device, scheme_of, urls
from errormotion.campaign.files import BenchCompensator, BenchInstrument, BenchPlan
from errormotion.errors import RunError
from errormotion.state import open_itself, own_folder, state_folder

try:
    import fcntl
except ImportError:  # Windows: no locks, and no claims
    fcntl = None  # type: ignore[assignment]

Role = Literal["measure", "follow", "offset", "show"]
"""Why an address is claimed. ``measure`` and ``offset`` exclude their like; ``follow``, the readings of a compensation,
goes beside a measurement, which shows its effect; ``show``, a simulated device, excludes nothing."""

FOLDERS = ("/run/lock/errormotion", "/tmp/errormotion-lock")
"""Folders of the computer; the first that every user may use is used."""
LOCK = "lock"
"""File in such a folder by which claims are serialized."""
SHARED = 0o1777
"""Mode of such a folder: everybody writes, and removes only what is his own."""
RELEASE_TIMEOUT = 15.0
"""Longest time for which a claim waits until programs that display readings have closed the instruments, s."""
LOCK_TIMEOUT = 10.0
"""Longest time for which a claim waits for another that is just being made, s."""
POLL_INTERVAL = 0.05
MAX_CLAIM = 1 << 16
"""Largest size of a claim, bytes."""
MAX_CLAIMS = 5000
"""Number of files of the folder that are examined."""
MAX_TEXT = 300

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Claim:
    """The program that uses devices: ``what`` it does, and its run folder as soon as it has one.

    ``user``, ``process`` and ``since`` state who, by name, process id, and local time.
    """

    what: str
    run: Path | None = None
    user: str = field(default="", compare=False)
    process: int = field(default=0, compare=False)
    since: str = field(default="", compare=False)

    def __str__(self) -> str:
        """Return user, process, start, purpose and run folder as text."""
        where = f", run folder {self.run}" if self.run is not None else ""
        return f"{self.what} of user {self.user}, process {self.process}, since {self.since}{where}"


@dataclass(frozen=True)
class Use:
    """One address that a program needs: its hash, why it is claimed, and what it is for messages."""

    key: str
    role: Role
    label: str


class Held:
    """A claim in effect. ``note`` states why other users' programs may not see it; empty if they do."""

    def __init__(self, descriptor: int, content: dict[str, Any], note: str) -> None:
        self._descriptor, self._content, self.note = descriptor, content, note
        self._write()

    def records(self, run: Path) -> None:
        """State the run folder of the program."""
        self._content["run"] = str(run.resolve())
        self._write()

    def _write(self) -> None:
        if self._descriptor >= 0:
            text = json.dumps(self._content).encode() + b"\n"
            with suppress(OSError):
                os.pwrite(self._descriptor, text, 0)
                os.ftruncate(self._descriptor, len(text))


def uses(plan: BenchPlan, role: Role = "measure", *, only: str = "", offsets: bool = False) -> tuple[Use, ...]:
    """Return the addresses of the instruments of a bench.

    Parameters
    ----------
    plan : BenchPlan
    role : str
        Why they are claimed.
    only : str, optional
        Name of one instrument; default: all.
    offsets : bool
        Whether offsets are written to the compensator of the bench.
    """
    used = [_use(plan.machine, each, role) for each in plan.instruments if only in ("", each.name)]
    if offsets and plan.compensator is not None:
        used.append(_use(plan.machine, plan.compensator, "offset"))
    return tuple(each for part in used for each in part)


def use_of(url: str) -> Use:
    """Return the use of one address by a measurement."""
    return Use(_hash(same_device(url)), "show" if scheme_of(url) in EXEMPT else "measure", url)


@contextmanager
def claimed(wanted: Iterable[Use], what: str) -> Iterator[Held]:
    """Claim addresses, and wait until programs that display readings have closed the instruments.

    Parameters
    ----------
    wanted : iterable of Use
    what : str
        Activity of the program, such as ``a run``.

    Raises
    ------
    RunError
        Another program has claimed one of them. Nothing was claimed.
    """
    wanted = tuple(wanted)
    folder, note = _folder()
    if note:
        log.warning("%s", note)
    if folder is None:  # a measurement does not depend on a claim
        yield Held(-1, {}, note)
        return
    with _new_file(folder, "claim", wanted, what, note) as held:
        _wait(folder, wanted)
        yield held


def require_free(wanted: Iterable[Use]) -> None:
    """Raise RunError if another program has claimed one of the addresses."""
    if (folder := _folder()[0]) is not None:
        _refuse_conflict(folder, tuple(wanted))


def holder(wanted: Iterable[Use]) -> Claim | None:
    """Return the newest claim of one of the addresses, or None."""
    keys, folder = {each.key for each in wanted}, _folder()[0]
    if folder is None:
        return None
    holders = [(time_ns, claim) for time_ns, claim, theirs in _locked(folder, "claim") if keys & theirs.keys()]
    return max(holders, key=lambda each: each[0])[1] if holders else None


@contextmanager
def watching(wanted: Iterable[Use]) -> Iterator[bool]:
    """Register a program that displays readings; the context returns whether the instruments are free of claims."""
    wanted, folder = tuple(wanted), _folder()[0]
    if folder is None:
        yield True
        return
    watched = tuple(Use(each.key, "show", each.label) for each in wanted)
    with _new_file(folder, "watch", watched, "", ""):
        yield holder(wanted) is None  # tested after the registration: a later claim waits for its end


@contextmanager
def _new_file(folder: Path, ending: str, wanted: tuple[Use, ...], what: str, note: str) -> Iterator[Held]:
    """Make and lock the file of a program, unless its uses are in conflict with a claim."""
    path = folder / f"{uuid4().hex}.{ending}"
    descriptor = -1
    try:
        with _one_at_a_time(folder):
            _remove_ended(folder)
            _refuse_conflict(folder, wanted)
            try:
                descriptor = open_itself(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
                os.fchmod(descriptor, 0o644)  # every user reads it, whatever the mask
                fcntl.flock(descriptor, fcntl.LOCK_EX)
            except OSError as error:
                raise RunError(
                    f"{path}: the instruments cannot be claimed: {error.strerror}", code="claim.not_written"
                ) from error
            content = {"what": what, "run": "", "process": os.getpid(), "keys": {e.key: e.role for e in wanted}}
            content["since"] = f"{datetime.now(UTC).astimezone():%Y-%m-%d %H:%M:%S}"
            held = Held(descriptor, content, note)
        yield held
    finally:
        if descriptor >= 0:
            path.unlink(missing_ok=True)
            os.close(descriptor)


@contextmanager
def _one_at_a_time(folder: Path) -> Iterator[None]:
    """Serialize claims, so that of two programs that start at the same time one is refused."""
    path = folder / LOCK
    try:
        descriptor = _lock_file(folder)
    except OSError as error:
        raise RunError(
            f"{path}: the instruments cannot be claimed: {error.strerror}", code="claim.not_written"
        ) from error
    try:
        end = time.monotonic() + LOCK_TIMEOUT
        while not _try_lock(descriptor):
            if time.monotonic() > end:
                raise RunError(
                    f"{path}: another program has held this lock for {LOCK_TIMEOUT:g} s; find and end it",
                    code="claim.lock.held",
                )
            time.sleep(POLL_INTERVAL)
        yield
    finally:
        os.close(descriptor)


def _lock_file(folder: Path) -> int:
    """Open the file by which claims are serialized; create it if it is missing."""
    try:
        return open_itself(folder / LOCK, os.O_RDONLY)
    except FileNotFoundError:
        descriptor = open_itself(folder / LOCK, os.O_RDONLY | os.O_CREAT, 0o644)
        with suppress(OSError):
            os.fchmod(descriptor, 0o644)
        return descriptor


def _try_lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _refuse_conflict(folder: Path, wanted: tuple[Use, ...]) -> None:
    exclusive = {(each.key, each.role): each for each in wanted if each.role in ("measure", "offset")}
    if not exclusive:
        return
    for _, claim, theirs in _locked(folder, "claim"):
        for each in theirs.items():
            if each in exclusive:
                raise RunError(
                    f"{exclusive[each].label} is in use by another program: {claim}. Wait for its end, or stop it "
                    "there. Nothing was opened, and nothing was created.",
                    code="claim.instrument.used",
                )


def _wait(folder: Path, wanted: tuple[Use, ...]) -> None:
    keys, end = {each.key for each in wanted}, time.monotonic() + RELEASE_TIMEOUT
    while any(keys & theirs.keys() for _, _, theirs in _locked(folder, "watch")):
        if time.monotonic() > end:
            log.warning("another program still reads the instruments")
            return
        time.sleep(POLL_INTERVAL)


def _locked(folder: Path, ending: str) -> list[tuple[int, Claim, Mapping[str, str]]]:
    """Return time (ns), claim, and hashes with their roles, of each program that is alive."""
    locked = []
    for _, descriptor in _files(folder, f".{ending}"):
        state = os.fstat(descriptor)
        if stat.S_ISREG(state.st_mode) and not _free(descriptor):
            locked.append((state.st_mtime_ns, *_read(descriptor, state.st_uid)))
    return locked


def _remove_ended(folder: Path) -> None:
    """Remove the files of killed programs; call it while no file is being made."""
    for path, descriptor in _files(folder, (".claim", ".watch")):
        if _free(descriptor):
            with suppress(OSError):  # of another user
                path.unlink()


def _files(folder: Path, endings: str | tuple[str, ...]) -> Iterator[tuple[Path, int]]:
    """Yield the files of programs, each opened until the next one."""
    try:
        names = sorted(name for name in os.listdir(folder) if name.endswith(endings))
    except OSError:
        return
    for name in names[:MAX_CLAIMS]:
        try:
            descriptor = open_itself(folder / name, os.O_RDONLY)
        except OSError:  # ended, or not a file of this program
            continue
        try:
            yield folder / name, descriptor
        finally:
            os.close(descriptor)


def _free(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _read(descriptor: int, owner: int) -> tuple[Claim, Mapping[str, str]]:
    try:
        content: Any = json.loads(os.pread(descriptor, MAX_CLAIM, 0))
        keys = {str(key): str(role) for key, role in content["keys"].items()}
        run = Path(content["run"]) if content["run"] else None
        what, since = _text(content["what"]), _text(content["since"])
        return Claim(what, run, _user(owner), int(content["process"]), since), keys
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):  # it is being written
        return Claim("another program", user=_user(owner)), {}


def _text(value: Any) -> str:
    return "".join(each if each.isprintable() else "?" for each in str(value)[:MAX_TEXT])


def _user(number: int) -> str:
    import pwd

    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)


def _folder() -> tuple[Path | None, str]:
    """Return the folder of claims, None if there is none, and a note if it is not the first choice."""
    if fcntl is None:
        return None, "This system has no file locks: whether another program uses the instruments is not known."
    for place in FOLDERS:
        if _is_shared(place) and _can_lock(place):
            other = f"{FOLDERS[0]} cannot be used; the claims of the instruments are in {place}."
            return Path(place), "" if place == FOLDERS[0] else other
    own = state_folder() / "claims"
    try:
        own_folder("claims")
    except OSError as error:
        none = f"No folder for claims of the instruments can be used ({', '.join(FOLDERS)}, {own}: {error.strerror})."
        return None, f"{none} Whether another program uses the instruments is not known."
    if not _can_lock(str(own)):
        return None, (
            f"No file can be locked in {', '.join(FOLDERS)} or {own}. Whether another program uses the instruments is "
            "not known; start no second one on this machine."
        )
    return own, (
        f"None of {', '.join(FOLDERS)} can be used by every user of this computer; the claims of the instruments are "
        f"in {own}. Programs of other users do not see them."
    )


def _can_lock(place: str) -> bool:
    """Return whether files of a folder can be locked; some file systems refuse it."""
    try:
        status = os.stat(place)
    except OSError:
        return False
    return _locks(place, status.st_dev, status.st_ino)


@cache
def _locks(place: str, device: int, number: int) -> bool:  # noqa: ARG001 - of the folder, which may be replaced
    try:
        descriptor = _lock_file(Path(place))
    except OSError as error:  # a folder with a lock that is not one: claims there are refused, and nothing is hidden
        return error.errno in (errno.ELOOP, errno.EINVAL)
    try:
        _free(descriptor)
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return True


def _is_shared(place: str) -> bool:
    """Return whether every user may lock in a folder, which is created if necessary; a link is not followed."""
    if not os.path.lexists(place):
        mask = os.umask(0)  # the folder has its mode from the first instant on
        try:
            os.mkdir(place, SHARED)
        except OSError:
            pass  # another program has just created it, or it cannot be created
        finally:
            os.umask(mask)
    try:
        status = os.lstat(place)
    except OSError:
        return False
    right = stat.S_ISDIR(status.st_mode) and stat.S_IMODE(status.st_mode) & SHARED == SHARED
    return right and os.access(place, os.W_OK | os.X_OK)


def _use(machine: str, device: BenchInstrument | BenchCompensator, role: Role) -> list[Use]:
    name = device.name if isinstance(device, BenchInstrument) else "the offset output"
    keys = []
    for url in urls(device):
        same, own = same_device(url), role
        if scheme_of(url) in EXEMPT or not same:  # of this process, or of this user
            same = f"{state_folder()}|{machine}|{device.driver.info.id}|{url}"
            own = "show" if url else role
        elif is_line(url):
            own = "measure"
        keys.append(Use(_hash(same), own, f"{name} ({url})" if url else name))
    return keys


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:32]
