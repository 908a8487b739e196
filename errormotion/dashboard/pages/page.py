"""The base class of all handlers: access, headers, templates, error messages."""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from jinja2 import Environment, PackageLoader, StrictUndefined
from tornado.ioloop import IOLoop
from tornado.web import HTTPError, RequestHandler

from errormotion import __version__
from errormotion.dashboard.access import Access
from errormotion.dashboard.lab import Lab, NotFoundError
from errormotion.dashboard.watch import Watch
from errormotion.errors import ErrormotionError
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
MAX_MESSAGE = 2000
"""Longest message on a page, characters."""

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

    @property
    def cookie(self) -> str:
        """Name of the session cookie."""
        return COOKIE.format(port=self.port)


class Guarded(RequestHandler):
    """Handler that checks host name and origin, and unless it is ``public`` the session."""

    public = False
    controls = False
    """Whether requests start, stop or change something; they are refused without ``--allow-control``."""

    def initialize(self, context: Context) -> None:
        """Set the context of the server."""
        self.context = context

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

    def prepare(self) -> None:
        """Refuse a request that violates the rules of access."""
        access, host = self.context.access, self.request.headers.get("Host", "")
        if not access.allows_host(host):
            raise HTTPError(421, reason="The host name is not one of this server; see --name")
        if self.request.method not in ("GET", "HEAD") and not access.same_origin(
            self.request.headers.get("Origin"), host
        ):
            raise HTTPError(403, reason="The request is not from a page of this server")
        if self.public or access.accepts_session(self.get_cookie(self.context.cookie)):
            if self.controls and not self.context.control:
                raise HTTPError(403, reason="The dashboard was started without --allow-control")
            return
        if self.request.method in ("GET", "HEAD") and "text/html" in self.request.headers.get("Accept", ""):
            self.redirect("/login")
            return
        raise HTTPError(403, reason="The token is required")

    async def in_thread(self, work: Callable[..., T], *values: Any) -> T:
        """Return the result of a function that runs in a thread, so that other requests are not delayed."""
        return await IOLoop.current().run_in_executor(self.context.workers, work, *values)

    async def in_slow_thread(self, work: Callable[..., T], *values: Any) -> T:
        """Return the result of a slow function that runs in a thread."""
        return await IOLoop.current().run_in_executor(self.context.slow, work, *values)

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

    def show(self, template: str, **values: Any) -> None:
        """Send a page; every value is escaped."""
        machine = self.context.watch.plan.machine if self.context.watch is not None else ""
        common: dict[str, Any] = {"pages": self.context.pages, "here": self.request.path, "machine": machine}
        common |= {"version": __version__, "guarded": bool(self.context.access.token)}
        self.finish(self.context.environment.get_template(template).render(**common, **values))

    def write_error(self, status_code: int, **kwargs: Any) -> None:  # noqa: ARG002 - as tornado calls it
        """Send an error message: that of an ErrormotionError, otherwise only the reason of the HTTP status."""
        error = kwargs.get("exc_info", (None, None, None))[1]
        message = self._reason
        if isinstance(error, ErrormotionError):
            self.set_status(404 if isinstance(error, NotFoundError) else 400)
            message = str(error)
        elif not isinstance(error, HTTPError):
            message = "Internal error; the traceback is in the log file of the command."
        if "text/html" in self.request.headers.get("Accept", ""):
            self.show("error.html.j2", message=message[:MAX_MESSAGE])
        else:
            self.finish({"error": message[:MAX_MESSAGE]})

    def log_exception(self, kind: Any, value: BaseException | None, trace: Any) -> None:
        """Log unexpected errors with their traceback; never a query, a header or a body."""
        if isinstance(value, ErrormotionError | HTTPError):
            log.info("%s %s: %s", self.request.method, self.request.path, value)
        else:
            log.error("%s %s", self.request.method, self.request.path, exc_info=(kind, value, trace))  # type: ignore[arg-type]


def note_request(handler: RequestHandler) -> None:
    """Log a request without its query, which may contain private data."""
    log.debug("%s %s: %d", handler.request.method, handler.request.path, handler.get_status())
