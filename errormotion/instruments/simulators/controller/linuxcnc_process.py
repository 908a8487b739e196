"""A real LinuxCNC, started without hardware, and ended with all its processes.

A computer can only run one LinuxCNC: its realtime memory has a fixed name. A file is therefore locked while a simulated
one runs (only its processes hold the lock), a second start waits for the end of the first, and any other LinuxCNC,
which may run a machine, is never changed.
"""

from __future__ import annotations

import atexit
import fcntl
import json
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from errormotion.errors import InstrumentError

PACKAGE = "linuxcnc-uspace"
PYTHON = "/usr/bin/python3"
LOCK = Path("/tmp/errormotion-linuxcnc.lock")
LINUXCNC_LOCK = Path("/tmp/linuxcnc.lock")
FOLDER = "errormotion-linuxcnc-"
MARKER_FILE = "processes"
"""File in its folder that its processes, and no others, keep open."""
PATH = "/usr/sbin:/usr/bin:/sbin:/bin"
NML = Path("/usr/share/linuxcnc/linuxcnc.nml")
PROCESSES = ("milltask", "rtapi_app", "linuxcncsvr")
MEMORY = ("0x48414c32", "0x90280a48", "0x48484c34", *(f"0x{key:x}" for key in range(1001, 1006)))
"""Keys of the shared memory that a killed LinuxCNC leaves: HAL, RTAPI, and its messages."""
MEMORY_TABLE = Path("/proc/sysvipc/shm")
START_TIMEOUT = 15.0  # s for LinuxCNC to start
END_TIMEOUT = 10.0  # s for LinuxCNC to end


def why_not() -> str:
    """Return why LinuxCNC cannot be started; empty if it can."""
    if shutil.which("linuxcnc") is None:
        return f"LinuxCNC is not installed on this computer; on Debian: apt install {PACKAGE}"
    if not NML.exists():
        return f"{NML} is missing; install {PACKAGE} again"
    return ""


def installed() -> str:
    """Return name and version of the installed LinuxCNC; InstrumentError if its Python module does not load."""
    done = subprocess.run(
        [PYTHON, "-c", "import hal, linuxcnc; print(linuxcnc.version)"], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise InstrumentError(
            f"LinuxCNC's module for {PYTHON} does not load: {done.stderr.strip()[-300:]}",
            code="simulator.linuxcnc.not_loaded",
        )
    return f"LinuxCNC {done.stdout.strip()}"


def for_doctor() -> str:
    """Return the installed LinuxCNC, which is only needed for simulation; InstrumentError for a broken installation."""
    if shutil.which("linuxcnc") is None:
        return f"not installed; needed for sim://.../linuxcnc only: {why_not()}"
    if reason := why_not():
        raise InstrumentError(reason, code="simulator.linuxcnc.missing")
    return f"{installed()}, for sim://.../linuxcnc"


DOCTOR = {"LinuxCNC": for_doctor}
"""Checks for ``errormotion doctor``."""


class LinuxCNCProcess:
    """A LinuxCNC that runs with the files in a folder.

    Parameters
    ----------
    files : mapping of str to str
        Files of the folder, name to text, with ``linuxcnc.ini``. ``{folder}`` in them stands for the folder.
    bridge : Path
        The bridge, used as the display.
    wait : float
        Longest wait for the end of another simulated LinuxCNC, s.

    Attributes
    ----------
    port : int
        Port of the bridge on 127.0.0.1.

    Raises
    ------
    InstrumentError
        LinuxCNC is not installed, another one does not end in time, or it does not start; the message has the end of
        its log.
    """

    def __init__(self, files: dict[str, str], bridge: Path, *, wait: float = 60.0) -> None:
        if reason := why_not():
            raise InstrumentError(reason, code="simulator.linuxcnc.missing")
        lock = _lock(wait)
        try:
            _refuse_beside_another()
            _remove_memory()
            for left in Path(tempfile.gettempdir()).glob(f"{FOLDER}*"):  # left by a killed process
                shutil.rmtree(left, ignore_errors=True)
            self.folder = Path(tempfile.mkdtemp(prefix=FOLDER))
            try:
                self._write(files, bridge)
                self._child = self._start(lock)
            except BaseException:
                shutil.rmtree(self.folder, ignore_errors=True)
                raise
        finally:
            os.close(lock)  # the processes of LinuxCNC now hold it
        atexit.register(self.end)
        try:
            self.socket, self._bridge = self._await()
            self.token = (self.folder / "token").read_text().strip()
        except BaseException:
            self.end()
            raise

    @property
    def running(self) -> bool:
        """Whether LinuxCNC is running."""
        return self._child.poll() is None

    def end(self) -> None:
        """End LinuxCNC and all its processes; idempotent."""
        atexit.unregister(self.end)
        if self.running:
            if getattr(self, "_bridge", 0) in _parts(self.folder):  # LinuxCNC ends with its display
                _kill([self._bridge], signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                self._child.wait(END_TIMEOUT)
        self._kill_the_rest()
        self._child.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    # ------------------------------------------------------------------ start

    def _write(self, files: dict[str, str], bridge: Path) -> None:
        for name, text in files.items():
            (self.folder / name).write_text(text.replace("{folder}", str(self.folder)))
        (self.folder / "linuxcnc.tbl").touch()
        (self.folder / "linuxcnc.var").touch()
        nml = NML.read_text().replace(" TCP=5005", "")  # no connections from other computers
        (self.folder / "linuxcnc.nml").write_text(nml)
        shutil.copy(bridge, self.folder / "bridge.py")
        (self.folder / "bridge.py").chmod(0o755)
        user = _user()
        if user is not None:
            for path in (self.folder, *self.folder.iterdir()):
                os.chown(path, user.pw_uid, user.pw_gid)

    def _start(self, lock: int) -> subprocess.Popen[bytes]:
        user = _user()
        environment = {"HOME": str(self.folder), "PATH": PATH, "LC_ALL": "C.UTF-8"}
        with (self.folder / "log.txt").open("wb") as log, (self.folder / MARKER_FILE).open("wb") as sign:
            return subprocess.Popen(
                ["linuxcnc", "-r", str(self.folder / "linuxcnc.ini")],
                cwd=self.folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                pass_fds=(lock, sign.fileno()),
                user=user.pw_uid if user else None,
                group=user.pw_gid if user else None,
                extra_groups=[] if user else None,
            )

    def _await(self) -> tuple[Path, int]:
        until = time.monotonic() + START_TIMEOUT
        file = self.folder / "bridge.json"
        while not file.exists():
            if not self.running or time.monotonic() > until:
                why = "ended at once" if not self.running else f"did not start within {START_TIMEOUT:g} s"
                log = (self.folder / "log.txt").read_text(errors="replace")
                raise InstrumentError(
                    f"LinuxCNC {why}; end of its log:\n{log[-2000:]}", code="simulator.linuxcnc.not_started"
                )
            time.sleep(0.02)
        announced = json.loads(file.read_text())
        return Path(announced["socket"]), int(announced["pid"])

    # ------------------------------------------------------------------ end

    def _kill_the_rest(self) -> None:
        if self._child.poll() is None or _parts(self.folder):
            user = _user()
            # the realtime process belongs to root, and is stopped by a request
            with suppress(OSError, subprocess.TimeoutExpired):
                subprocess.run(
                    ["rtapi_app", "exit"],
                    env={"HOME": str(self.folder), "PATH": PATH},
                    capture_output=True,
                    timeout=END_TIMEOUT,
                    check=False,
                    user=user.pw_uid if user else None,
                    group=user.pw_gid if user else None,
                )
            _kill(_parts(self.folder))
            with suppress(InstrumentError):  # if the next one has already started, the memory belongs to it
                lock = _lock(0.0)
                _remove_memory()
                os.close(lock)


def _user() -> pwd.struct_passwd | None:
    """Return the user of LinuxCNC, which refuses root: ``nobody`` for root, else None for the present user."""
    return pwd.getpwnam("nobody") if os.geteuid() == 0 else None


def _parts(of: Path | None = None) -> dict[int, str]:
    """Return the processes of simulated LinuxCNCs, or of the one in a folder, by name, from their open marker files.

    Processes of other users are not visible.
    """
    prefix = f"{of or Path(tempfile.gettempdir()) / FOLDER}"
    found = {}
    for pid, (name, _) in _processes().items():
        with suppress(OSError):
            links = [os.readlink(each) for each in Path(f"/proc/{pid}/fd").iterdir()]
            if any(
                link.startswith(prefix) and Path(link.removesuffix(" (deleted)")).name == MARKER_FILE for link in links
            ):
                found[pid] = name
    return found


def _kill(processes: Iterable[int], number: int = signal.SIGKILL) -> None:
    """Send a signal to processes; by default they end at once."""
    for pid in processes:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(pid, number)


def _remove_memory() -> None:
    """Remove the memory of a killed LinuxCNC. The lock must be held, since a running one has the same keys.

    The next LinuxCNC would otherwise read the old messages, and its processes would wait for one another.
    """
    left = {int(line.split()[0]) % 2**32 for line in MEMORY_TABLE.read_text().splitlines()[1:]}
    for key in MEMORY:
        if int(key, 16) in left:
            subprocess.run(["ipcrm", "-M", key], capture_output=True, check=False)


def _lock(wait: float) -> int:
    """Return the locked file; InstrumentError if another simulated LinuxCNC does not end."""
    until, last_led = time.monotonic() + wait, time.monotonic()
    with suppress(FileExistsError):
        os.close(os.open(LOCK, os.O_CREAT | os.O_EXCL | os.O_RDONLY, 0o644))
    file = os.open(LOCK, os.O_RDONLY)
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return file
        except BlockingIOError:
            parts = _parts()
            if not parts or "bridge.py" in parts.values():
                last_led = time.monotonic()
            elif time.monotonic() - last_led > 2 * START_TIMEOUT:  # processes without a bridge
                _kill(parts)
            if time.monotonic() < until:
                time.sleep(0.1)
                continue
            os.close(file)
            raise InstrumentError(
                "A computer can only run one LinuxCNC; another simulated one did not end in time, "
                f"in {wait:g} s. Close it, or wait longer with 'wait=' in the address",
                code="simulator.linuxcnc.used",
            ) from None


def _refuse_beside_another() -> None:
    """Refuse to start beside a LinuxCNC that is not simulated: it may run a machine."""
    found = {name: pid for pid, (name, state) in _processes().items() if name in PROCESSES and state != "Z"}
    if found:
        named = ", ".join(f"{name} ({pid})" for name, pid in sorted(found.items()))
        raise InstrumentError(
            f"A LinuxCNC that is not simulated runs on this computer: {named}", code="simulator.linuxcnc.used"
        )
    with suppress(OSError):
        LINUXCNC_LOCK.unlink()  # left by a killed LinuxCNC


def _processes() -> dict[int, tuple[str, str]]:
    """Return name and state of every process."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError):
                head, _, tail = (entry / "stat").read_text(errors="replace").rpartition(")")
                found[int(entry.name)] = (head.partition("(")[2], tail.split()[0])
    return found
