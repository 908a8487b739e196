"""A command on a pseudo terminal: what it shows, and what a person types."""

import os
import pty
import select
import signal
import time
from pathlib import Path

from forked_commands import Commands


class Terminal:
    """``errormotion ARGUMENTS`` on a terminal."""

    def __init__(self, commands: Commands, folder: Path, *arguments: str, **environment: str) -> None:
        self._own, theirs = pty.openpty()
        variables = {"COLUMNS": "400", "TERM": "dumb"} | environment
        self.process = commands.start_on(theirs, *arguments, cwd=folder, environment=variables)
        os.close(theirs)
        self.shown = ""

    def wait_for(self, text: str, seconds: float = 60.0) -> None:
        """Wait until a text is shown, or the end of the command."""
        end = time.monotonic() + seconds
        while text not in self.shown:
            assert time.monotonic() < end, self.shown
            if not self._read():
                break
        assert text in self.shown, self.shown

    def type(self, text: str) -> None:
        """Type a text."""
        os.write(self._own, text.encode())

    def end(self, seconds: float = 120.0) -> int:
        """Wait for the end; return the exit code."""
        end = time.monotonic() + seconds
        while self._read():
            assert time.monotonic() < end, self.shown
        self.process.communicate(10)
        assert self.process.returncode is not None
        return self.process.returncode

    def close(self) -> None:
        """End the command."""
        self.process.send_signal(signal.SIGKILL)
        self.process.close()
        os.close(self._own)

    def _read(self) -> bool:
        if not select.select([self._own], [], [], 0.2)[0]:
            return self.process.poll() is None
        try:
            found = os.read(self._own, 65536)
        except OSError:  # the command has closed the terminal
            return False
        self.shown += found.decode("utf-8", "replace")
        return bool(found)
