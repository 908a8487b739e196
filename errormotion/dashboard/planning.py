"""Plans of campaigns in a process of their own, which ends with the request: a plan can take minutes."""

from __future__ import annotations

import asyncio
import json
import sys
from asyncio.subprocess import Process
from contextlib import suppress
from pathlib import Path
from typing import Any

from errormotion.dashboard.campaigns import Campaigns
from errormotion.errors import ErrormotionError, RunError

TIMEOUT = 300.0
"""Longest time of a plan, s."""
MOST, WAITING = 2, 6
"""Number of plans at a time, and of those that wait."""
MAX_ANSWER = 64 << 20
"""Largest size of a plan, bytes."""


class Planner:
    """Plans of one server. Its processes wait for the next plan; one whose client has left is killed."""

    def __init__(self) -> None:
        self._turn = asyncio.Semaphore(MOST)
        self._waiting = 0
        self._idle: list[Process] = []
        self._starting = False

    async def plan(self, campaigns: Campaigns, name: str, text: str) -> list[dict[str, Any]]:
        """Return the plan of a campaign text, as `Campaigns.plan`; if cancelled, its process is killed.

        Raises
        ------
        RunError
            The text has mistakes, too many plans wait, or the plan takes too long.
        """
        if self._waiting >= MOST + WAITING:
            raise RunError(f"{self._waiting} plans are being made; try again later", code="plan.too_many")
        bench = None if campaigns.bench is None else str(campaigns.bench)
        request = {"folder": str(campaigns.folder), "control": campaigns.control, "bench": bench}
        self._waiting += 1
        try:
            async with self._turn:
                found = await asyncio.wait_for(self._answer({**request, "name": name, "text": text}), TIMEOUT)
        except TimeoutError:
            raise RunError(
                f"The plan takes more than {TIMEOUT:g} s; use 'errormotion plan'", code="plan.timeout"
            ) from None
        finally:
            self._waiting -= 1
        if "error" in found:
            raise RunError(found["error"], code=found["code"])
        tests: list[dict[str, Any]] = found["tests"]
        return tests

    async def prepare(self) -> None:
        """Start a process, so that the first plan does not wait for it."""
        if not self._idle and not self._starting and not self._waiting:
            self._starting = True
            try:
                self._idle.append(await _started())
            finally:
                self._starting = False

    async def end(self) -> None:
        """End the processes."""
        while self._idle:
            await _kill(self._idle.pop())

    async def _answer(self, request: dict[str, Any]) -> dict[str, Any]:
        process = self._idle.pop() if self._idle else await _started()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(request).encode() + b"\n")
            await process.stdin.drain()
            found: dict[str, Any] = json.loads(await process.stdout.readline())
        except (OSError, ValueError):
            await _kill(process)
            raise RunError(
                "The plan could not be made: its process ended without an answer", code="plan.failed"
            ) from None
        except BaseException:  # the client has left, or it takes too long
            await _kill(process)
            raise
        self._idle.append(process)
        return found


async def _started() -> Process:
    pipe = asyncio.subprocess.PIPE
    return await asyncio.create_subprocess_exec(
        sys.executable, "-P", "-m", __name__, stdin=pipe, stdout=pipe, stderr=asyncio.subprocess.DEVNULL,
        limit=MAX_ANSWER,
    )  # fmt: skip


async def _kill(process: Process) -> None:
    if process.returncode is None:
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()


def main() -> None:
    """Read requests from standard input, one in a line, and print a plan for each, or why there is none."""
    output, sys.stdout = sys.stdout, sys.stderr  # methods may print
    for line in sys.stdin.buffer:
        request = json.loads(line)
        bench = request["bench"]
        campaigns = Campaigns(Path(request["folder"]), request["control"], Path(bench) if bench else None)
        try:
            found: dict[str, Any] = {"tests": campaigns.plan(request["name"], request["text"])}
        except ErrormotionError as error:
            found = {"error": str(error), "code": error.code}
        output.write(json.dumps(found) + "\n")
        output.flush()


if __name__ == "__main__":
    main()
