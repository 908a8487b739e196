"""The base of every handler: access, headers, templates, and errors as text."""

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

T = TypeVar("T")

COOKIE = "errormotion-{port}"
"""Cookie of a browser that has presented the token; browsers share cookies among the ports of a computer."""
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "font-src 'self'; connect-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)
"""What a page may load: nothing from elsewhere, and no script that stands in the page."""
LONGEST_MESSAGE = 2000
"""Characters of a message on a page."""

log = logging.getLogger(__name__)


def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("errormotion.dashboard"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters["signs"] = signs
    return made


@dataclass(frozen=True)
class Context:
    """What every handler knows of its server."""

    access: Access
    lab: Lab
    port: int
    workers: Executor
    slow: Executor
    """For work that may take long, such as comparisons, so that it does not hold up the rest."""
    pages: tuple[tuple[str, str], ...]
    """Paths and titles of the pages in the bar."""
    watch: Watch | None = None
    """Of the bench, where one was given."""
    control: bool = False
    """Whether pages may start and stop what moves or changes a machine."""
    campaigns: Path = Path()
    """Folder of the campaign files."""
    environment: Environment = field(default_factory=_environment)

    @property
    def cookie(self) -> str:
        """Name of the session's cookie."""
        return COOKIE.format(port=self.port)


class Guarded(RequestHandler):
    """Refuses foreign names and origins; a subclass that is not ``public`` needs the session of the token as well."""

    public = False
    controls = False
    """Whether requests start, stop or change something: refused unless the dashboard was started for that."""

    def initialize(self, context: Context) -> None:
        """Take what the server knows."""
        self.context = context

    def set_default_headers(self) -> None:
        """Set the headers that hold for every answer."""
        self.clear_header("Server")
        for name, value in (
            ("Content-Security-Policy", POLICY),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "same-origin"),  # without any, browsers hide the origin of a form
            ("Cross-Origin-Opener-Policy", "same-origin"),
            ("Cross-Origin-Resource-Policy", "same-origin"),
            ("Cache-Control", "no-store"),
        ):
            self.set_header(name, value)

    def prepare(self) -> None:
        """Refuse a request that may not be answered."""
        access, host = self.context.access, self.request.headers.get("Host", "")
        if not access.admits(host):
            raise HTTPError(421, reason="This server has another name")
        if self.request.method not in ("GET", "HEAD") and not access.same_origin(
            self.request.headers.get("Origin"), host
        ):
            raise HTTPError(403, reason="The request comes from another page")
        if self.public or access.knows(self.get_cookie(self.context.cookie)):
            if self.controls and not self.context.control:
                raise HTTPError(403, reason="The dashboard was started without --allow-control")
            return
        if self.request.method in ("GET", "HEAD") and "text/html" in self.request.headers.get("Accept", ""):
            self.redirect("/login")
            return
        raise HTTPError(403, reason="The token is required")

    async def apart(self, work: Callable[..., T], *values: Any) -> T:
        """Return the result of work that takes time, done in a thread so that no other client waits."""
        return await IOLoop.current().run_in_executor(self.context.workers, work, *values)

    async def apart_slow(self, work: Callable[..., T], *values: Any) -> T:
        """Return the result of work that may take long."""
        return await IOLoop.current().run_in_executor(self.context.slow, work, *values)

    def word(self, name: str, longest: int = 400) -> str:
        """Return a value of the query, empty where there is none.

        Raises
        ------
        HTTPError
            It is longer than this number of characters.
        """
        text = self.get_query_argument(name, "") or ""
        if len(text) > longest:
            raise HTTPError(400, reason=f"{name} is too long")
        return text

    def show(self, template: str, **values: Any) -> None:
        """Write a page; every value is shown as text."""
        machine = self.context.watch.plan.machine if self.context.watch is not None else ""
        common: dict[str, Any] = {"pages": self.context.pages, "here": self.request.path, "machine": machine}
        common |= {"version": __version__, "guarded": bool(self.context.access.token)}
        self.finish(self.context.environment.get_template(template).render(**common, **values))

    def write_error(self, status_code: int, **kwargs: Any) -> None:  # noqa: ARG002 - as tornado calls it
        """Write what went wrong as text: the message of the project's own errors, else only what HTTP calls it."""
        error = kwargs.get("exc_info", (None, None, None))[1]
        message = self._reason
        if isinstance(error, ErrormotionError):
            self.set_status(404 if isinstance(error, NotFoundError) else 400)
            message = str(error)
        elif not isinstance(error, HTTPError):
            message = "Internal error; the traceback is in the log of the commands."
        if "text/html" in self.request.headers.get("Accept", ""):
            self.show("error.html.j2", message=message[:LONGEST_MESSAGE])
        else:
            self.finish({"error": message[:LONGEST_MESSAGE]})

    def log_exception(self, kind: Any, value: BaseException | None, trace: Any) -> None:
        """Log what nobody expects, with its traceback; never a query, a header or a body."""
        if isinstance(value, ErrormotionError | HTTPError):
            log.info("%s %s: %s", self.request.method, self.request.path, value)
        else:
            log.error("%s %s", self.request.method, self.request.path, exc_info=(kind, value, trace))  # type: ignore[arg-type]


def note_request(handler: RequestHandler) -> None:
    """Log an answer without its query: what a browser sends there is nobody's business."""
    log.debug("%s %s: %d", handler.request.method, handler.request.path, handler.get_status())
