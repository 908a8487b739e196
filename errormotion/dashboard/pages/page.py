"""The base class of all handlers: access, headers, templates, error messages."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from jinja2 import Environment, PackageLoader, StrictUndefined
from tornado.escape import json_encode
from tornado.ioloop import IOLoop
from tornado.web import HTTPError, RequestHandler

from errormotion import __version__
from errormotion.dashboard.access import Access
from errormotion.dashboard.door import Budget
from errormotion.dashboard.lab import Lab, NotFoundError
from errormotion.dashboard.load import REFUSAL_DELAY, Load, Share
from errormotion.dashboard.planning import Planner
from errormotion.dashboard.watch import Watch
from errormotion.errors import ErrormotionError, code_of
from errormotion.report.text import signs
from errormotion.tolerances.decision import INSIDE, OUTSIDE, decision_of

T = TypeVar("T")

COOKIE = "errormotion-{port}"
"""Name of the session cookie; it contains the port, since browsers share cookies among the ports of a computer."""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "font-src 'self'; connect-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
"""Content security policy: resources of this server only, and no inline scripts."""
STATE_WORKERS, STOP_WORKERS = 2, 2
"""Number of threads for the states on the pages with a stop button, and for requests to stop."""
HSTS = 365 * 24 * 3600
"""Time for which browsers connect to this host by TLS only, s."""
MAX_QUEUED = 64
"""Number of requests that wait for a thread of one kind."""
MAX_MESSAGE = 2000
"""Longest message on a page, characters."""
NO_CONTROL = "The dashboard was started without --allow-control"
CODES = {
    400: "request.form",
    403: "request.forbidden",
    404: "request.not_found",
    408: "request.timeout",
    503: "request.too_many",
}
"""Codes of the HTTP status in JSON answers."""

log = logging.getLogger(__name__)


def _environment() -> Environment:
    environment = Environment(
        loader=PackageLoader("errormotion.dashboard"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"signs": signs, "mark": _mark}
    return environment


def _mark(verdict: str) -> str:
    """Return the class of the mark of a verdict: ``good``, ``bad`` or ``open``."""
    return {INSIDE: "good", OUTSIDE: "bad"}.get(decision_of(verdict), "open")


@dataclass(frozen=True)
class Context:
    """Data of the server for all handlers."""

    access: Access
    lab: Lab
    port: int
    workers: Executor
    slow: Executor
    """For slow functions such as comparisons, which must not delay other requests."""
    pages: tuple[tuple[str, str], ...]
    """Paths and titles of the pages in the menu."""
    watch: Watch | None = None
    """Reader of the bench; None without a bench."""
    control: bool = False
    """Whether pages may start and stop campaigns and compensations."""
    campaigns: Path = Path()
    """Folder of the campaign files."""
    environment: Environment = field(default_factory=_environment)
    states: Executor = field(default_factory=lambda: ThreadPoolExecutor(STATE_WORKERS))
    """For the states on the pages from which something is stopped; used by nothing slow."""
    stops: Executor = field(default_factory=lambda: ThreadPoolExecutor(STOP_WORKERS))
    """For requests to stop, and nothing else."""
    planner: Planner = field(default_factory=Planner)
    budget: Budget = field(default_factory=Budget)
    load: Load = field(default_factory=Load)

    @property
    def cookie(self) -> str:
        """Name of the session cookie."""
        return COOKIE.format(port=self.port)


class Guarded(RequestHandler):
    """Handler that checks host name and origin, and unless it is ``public`` the session."""

    public = False
    controls = False
    """Whether requests start, stop or change something; they are refused without ``--allow-control``."""
    stops = False
    """Whether requests stop something: they are served under any load."""
    share: Share = "reading"
    """The share of its client from which a request is served, if it may read."""

    def initialize(self, context: Context) -> None:
        """Set the context of the server."""
        self.context = context
        self._work: list[asyncio.Future[Any]] = []
        self._counted: Share | None = None
        self._require_encryption()

    def set_default_headers(self) -> None:
        """Set the headers of every answer."""
        self.clear_header("Server")
        for name, value in (
            ("Content-Security-Policy", POLICY),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "same-origin"),  # without this header, browsers omit the origin of a form
            ("Cross-Origin-Opener-Policy", "same-origin"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Cache-Control", "no-store"),
        ):
            self.set_header(name, value)
        if hasattr(self, "context"):  # not in the constructor, which `initialize` follows
            self._require_encryption()

    def _require_encryption(self) -> None:
        if self.context.access.secure:
            self.set_header("Strict-Transport-Security", f"max-age={HSTS}")

    async def prepare(self) -> None:
        """Refuse a request that violates the rules of access, or exceeds the share of its client."""
        self.context.budget.settle(self._stream)
        access, session = self.context.access, self.get_cookie(self.context.cookie)
        method, host = str(self.request.method), self.request.headers.get("Host", "")
        found = access.refusal(
            method, self.request.headers, session, public=self.public, controls=self.controls and self.context.control
        )
        if found is None and self.controls and not self.context.control:
            found = 403, NO_CONTROL
        if found is not None or not self.stops:
            await self._count("open" if found is not None or self.public else self.share)
        if found is None:
            if not self.public:  # one with a wrong token waits, and must not occupy its place
                self.context.budget.begin(self._stream, trusted=bool(access.token))
            return
        wants_page = method in ("GET", "HEAD") and "text/html" in self.request.headers.get("Accept", "")
        if wants_page and access.allows_host(host) and not self.controls:
            self.redirect("/login")
            return
        raise HTTPError(found[0], reason=found[1])

    async def _count(self, share: Share) -> None:
        if self.context.load.begin(str(self.request.remote_ip), share):
            self._counted = share
            return
        await self.ending_with_the_client(asyncio.sleep(REFUSAL_DELAY))
        self.set_header("Retry-After", "2")
        raise HTTPError(503, reason="Too many requests of this client; try again later")

    @property
    def _stream(self) -> Any:
        return getattr(self.request.connection, "stream", None)

    def on_finish(self) -> None:
        """Count the connection as idle, and the request as answered."""
        self.context.budget.end(self._stream)
        if self._counted is not None:
            self.context.load.end(str(self.request.remote_ip), self._counted)
            self._counted = None

    def on_connection_close(self) -> None:
        """Cancel the work for a client that has left; what waits for a thread is not begun."""
        for each in self._work:
            each.cancel()

    async def in_thread(self, work: Callable[..., T], *values: Any) -> T:
        """Return the result of a function that runs in a thread, so that other requests are not delayed."""
        return await self._in(self.context.workers, work, *values)

    async def in_slow_thread(self, work: Callable[..., T], *values: Any) -> T:
        """Return the result of a slow function that runs in a thread."""
        return await self._in(self.context.slow, work, *values)

    async def in_state_thread(self, work: Callable[..., T], *values: Any) -> T:
        """Return the result of a fast function for a page from which something is stopped."""
        return await self._in(self.context.states, work, *values)

    async def in_stop_thread(self, work: Callable[..., T], *values: Any) -> T:
        """Return the result of a request to stop; it is carried out even if its client leaves."""
        return await IOLoop.current().run_in_executor(self.context.stops, work, *values)

    async def _in(self, threads: Executor, work: Callable[..., T], *values: Any) -> T:
        if getattr(threads, "_work_queue").qsize() >= MAX_QUEUED:  # noqa: B009 - Executor states no number
            raise HTTPError(503, reason="The server has too many requests; try again later")
        return await self.ending_with_the_client(IOLoop.current().run_in_executor(threads, work, *values))

    async def ending_with_the_client(self, work: Awaitable[T]) -> T:
        """Return a result that is not required if the client leaves meanwhile."""
        task = asyncio.ensure_future(work)
        self._work.append(task)
        try:
            return await task
        except asyncio.CancelledError:
            raise HTTPError(408, reason="The client has left") from None
        finally:
            self._work.remove(task)

    def value(self, name: str, longest: int = 400) -> str:
        """Return a value of the query; empty if it is missing.

        Raises
        ------
        HTTPError
            The value has more than ``longest`` characters.
        """
        text = self.get_query_argument(name, "") or ""
        if len(text) > longest:
            raise HTTPError(400, reason=f"{name} is too long")
        return text

    async def show(self, template: str, **values: Any) -> None:
        """Send a page, which a thread makes; every value is escaped."""
        threads = self.context.workers if self.share == "reading" else self.context.states
        self.finish(await self._in(threads, lambda: self._page(template, **values)))

    async def send(self, document: dict[str, Any]) -> None:
        """Send a JSON document, which a thread makes."""
        self.set_header("Content-Type", "application/json; charset=UTF-8")
        self.finish(await self.in_thread(json_encode, document))

    def _page(self, template: str, **values: Any) -> str:
        machine = self.context.watch.plan.machine if self.context.watch is not None else ""
        common: dict[str, Any] = {"pages": self.context.pages, "here": self.request.path, "machine": machine}
        common |= {"version": __version__, "guarded": bool(self.context.access.token)}
        return self.context.environment.get_template(template).render(**common, **values)

    def write_error(self, status_code: int, **kwargs: Any) -> None:
        """Send an error message: that of an ErrormotionError, otherwise only the reason of the HTTP status."""
        error = kwargs.get("exc_info", (None, None, None))[1]
        message = self._reason
        if isinstance(error, ErrormotionError):
            self.set_status(404 if isinstance(error, NotFoundError) else 400)
            message = str(error)
        elif not isinstance(error, HTTPError):
            message = "Internal error; the traceback is in the log file of the command."
        wants_page = "text/html" in self.request.headers.get("Accept", "")
        if wants_page and status_code == 503:  # one of many under load: text costs little
            self.set_header("Content-Type", "text/plain; charset=UTF-8")
            self.finish(message)
        elif wants_page:
            self.finish(self._page("error.html.j2", message=message[:MAX_MESSAGE]))
        else:
            code = code_of(
                error,
                CODES.get(self.get_status(), "request.refused") if isinstance(error, HTTPError) else "error.internal",
            )
            self.finish({"error": message[:MAX_MESSAGE], "code": code})

    def log_exception(self, kind: Any, value: BaseException | None, trace: Any) -> None:
        """Log unexpected errors with their traceback; never a query, a header or a body."""
        if isinstance(value, ErrormotionError | HTTPError):
            log.info("%s %s: %s", self.request.method, self.request.path, value)
        else:
            log.error("%s %s", self.request.method, self.request.path, exc_info=(kind, value, trace))  # type: ignore[arg-type]


def note_request(handler: RequestHandler) -> None:
    """Log a request without its query, which may contain private data."""
    log.debug("%s %s: %d", handler.request.method, handler.request.path, handler.get_status())
