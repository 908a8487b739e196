"""The server: routes, access, connection."""

from __future__ import annotations

import asyncio
import gzip
import ssl
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

from bokeh.util.paths import bokehjs_path
from tornado.httputil import HTTPHeaders, parse_cookie
from tornado.web import Application, HTTPError

from errormotion.campaign.files import load_bench
from errormotion.dashboard.access import LOOPBACK, Access, access_for
from errormotion.dashboard.door import Door, Server, listeners
from errormotion.dashboard.lab import Lab
from errormotion.dashboard.pages import adding, compare, compensate, measure, now, results
from errormotion.dashboard.pages.login import Login
from errormotion.dashboard.pages.page import NO_CONTROL, Context, Guarded, note_request
from errormotion.dashboard.uploads import MAX_UPLOAD, Uploads
from errormotion.dashboard.watch import Watch
from errormotion.errors import RunError

HERE = Path(__file__).parent
PAGES = (("/measure", "Measure"), ("/results", "Results"), ("/compare", "Compare"), ("/compensate", "Compensate"))
"""Paths and titles of the pages in the menu."""
BOKEH = ("bokeh.min.js",)
"""Scripts of bokeh that pages load."""
LOGIN = "/login"
TYPES = {".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8", ".svg": "image/svg+xml"}
"""Types of static files, by ending."""
WORKERS = 4
"""Number of threads for fast functions."""
SLOW_WORKERS = 2
"""Number of threads for slow functions."""
MAX_REQUEST = 1 << 20
"""Largest size of a request, bytes."""
MAX_HEADER = 1 << 15
"""Largest size of the header of a request, bytes."""
MAX_LOGIN = 1 << 12
"""Largest size of a request with a token, bytes."""
IDLE_TIMEOUT = 60.0
"""Time after which an idle connection is closed, s."""
BODY_TIMEOUT = 10.0
"""Time for the body of a request to arrive, s."""


@dataclass(frozen=True)
class Options:
    """Options of the server."""

    runs: Path
    host: str = LOOPBACK
    port: int = 5006
    names: tuple[str, ...] = ()
    cert: Path | None = None
    key: Path | None = None
    bench: Path | None = None
    interval: float = 1.0
    control: bool = False
    campaigns: Path = Path()


class Start(Guarded):
    """The address without a path."""

    def get(self) -> None:
        """Redirect to the page Now, or without a bench to Results."""
        self.redirect("/results" if self.context.watch is None else "/now")


class Missing(Guarded):
    """Any unknown address."""

    async def prepare(self) -> None:
        """Refuse the request, after the check of access."""
        await super().prepare()
        if not self._finished:
            raise HTTPError(404, reason="No such page")


class Static(Guarded):
    """Style, scripts and BokehJS, from the packages; each is read and compressed once."""

    public = True

    def initialize(self, context: Context, path: str) -> None:  # type: ignore[override]
        """Set the context of the server and the folder."""
        super().initialize(context)
        self._folder = Path(path)

    async def get(self, name: str) -> None:
        """Send the file; browsers may cache it if they check for changes."""
        as_gzip = "gzip" in self.request.headers.get("Accept-Encoding", "")
        content = await self.in_state_thread(_static, self._folder / name, as_gzip)
        self.set_header("Cache-Control", "no-cache")
        self.set_header("Vary", "Accept-Encoding")
        self.set_header("Content-Type", TYPES[Path(name).suffix])
        if as_gzip:
            self.set_header("Content-Encoding", "gzip")
        self.finish(content)


@cache
def _static(path: Path, as_gzip: bool) -> bytes:
    content = path.read_bytes()
    return gzip.compress(content) if as_gzip else content


def application(context: Context) -> Application:
    """Return the application of a server: routes and handlers."""
    one = {"context": context}
    scripts = "|".join(name.replace(".", r"\.") for name in BOKEH)
    return Application(
        [
            (r"/", Start, one),
            (LOGIN, Login, one),
            (r"/now", now.Now, one),
            (r"/now/values\.json", now.Values, one),
            (r"/now/figure\.json", now.Figure, one),
            (r"/now/history\.json", now.History, one),
            (r"/compare", compare.Compare, one),
            (r"/compare/figure\.json", compare.Figure, one),
            (r"/compare/report\.html", compare.Report, one),
            (r"/compare/history\.html", compare.History, one),
            *((path, handler, one) for path, handler in measure.HANDLERS),
            *compensate.handlers(context),
            (r"/results", results.Results, one),
            *((path, handler, one) for path, handler in adding.HANDLERS),
            (r"/run", results.Run, one),
            (r"/run/figure\.json", results.Figure, one),
            (r"/run/values\.csv", results.Values, one),
            (r"/run/space\.html", results.Space, one),
            (r"/run/file", results.File, one),
            (r"/static/(report\.js)", Static, {**one, "path": str(files("errormotion.report") / "page" / "templates")}),
            (r"/static/(dashboard\.css|[a-z]+\.js|icon\.svg)", Static, {**one, "path": str(HERE / "static")}),
            (rf"/static/({scripts})", Static, {**one, "path": str(bokehjs_path() / "js")}),
        ],
        default_handler_class=Missing,
        default_handler_args=one,
        log_function=note_request,
        compress_response=True,
    )


def door_of(context: Context, served: Application) -> Door:
    """Return the door of an application: requests with a body are refused by their header."""

    def refusal(method: str, path: str, headers: HTTPHeaders) -> tuple[int, str] | None:
        if path == adding.UPLOAD and not context.control:
            return 403, NO_CONTROL
        session = _cookie(headers.get("Cookie", ""), context.cookie)
        large = path == adding.UPLOAD  # only for those who may write
        return context.access.refusal(method, headers, session, public=path == LOGIN, controls=large)

    longest = {LOGIN: MAX_LOGIN, adding.UPLOAD: MAX_UPLOAD}
    return Door(served, refusal, lambda path: longest.get(path, MAX_REQUEST))


def _cookie(text: str, name: str) -> str | None:
    try:
        found = parse_cookie(text)
    except ValueError:
        return None
    return found.get(name)


async def serve(options: Options, started: Callable[[str, Access], None], end: asyncio.Event | None = None) -> None:
    """Serve until it is cancelled, or until an event.

    Parameters
    ----------
    options : Options
    started : callable
        Called with address and access when the server listens; only this function receives the token.
    end : asyncio.Event, optional

    Raises
    ------
    RunError
        The server cannot listen on the address, or certificate and key cannot be used.
    BenchError
        The bench file is invalid, or has no instruments for a monitor.
    """
    context_of_tls = _encryption(options)
    watch = Watch(load_bench(options.bench), options.runs, options.interval) if options.bench is not None else None
    access = access_for(options.host, options.names, secure=context_of_tls is not None, control=options.control)
    with (
        ThreadPoolExecutor(WORKERS, thread_name_prefix="errormotion-dashboard") as workers,
        ThreadPoolExecutor(SLOW_WORKERS, thread_name_prefix="errormotion-dashboard-slow") as slow,
    ):
        try:
            sockets = listeners(options.port, options.host)
        except OSError as error:
            raise RunError(
                f"{options.host}, port {options.port}: the server cannot listen: {error.strerror}",
                code="server.not_listening",
            ) from error
        port = int(sockets[0].getsockname()[1])
        pages = (*((("/now", "Now"),) if watch is not None else ()), *PAGES)
        context = Context(
            access, Lab(options.runs), port, workers, slow, pages, watch, options.control, options.campaigns
        )
        server = Server(
            door_of(context, application(context)),
            ssl_options=context_of_tls,
            idle_connection_timeout=IDLE_TIMEOUT,
            body_timeout=BODY_TIMEOUT,
            max_body_size=MAX_REQUEST,
            max_buffer_size=MAX_REQUEST,
            max_header_size=MAX_HEADER,
        )
        server.budget = context.budget
        server.add_sockets(sockets)
        if watch is not None:
            watch.start()
        if options.control:
            await asyncio.to_thread(Uploads(options.runs).clean)
        try:
            started(_address(options, port), access)
            await (end or asyncio.Event()).wait()
        finally:
            server.stop()
            if watch is not None:
                await asyncio.to_thread(watch.stop)
            await server.close_all_connections()
            await context.planner.end()
            context.states.shutdown()
            context.stops.shutdown()


def run(options: Options, started: Callable[[str, Access], None]) -> None:
    """Serve until Ctrl-C.

    Raises
    ------
    RunError
        As `serve`.
    """
    asyncio.run(serve(options, started))


def _encryption(options: Options) -> ssl.SSLContext | None:
    if options.cert is None and options.key is None:
        return None
    if options.cert is None or options.key is None:
        raise RunError("--cert and --key: expected both, or neither", code="server.certificate.half")
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        context.load_cert_chain(options.cert, options.key, password=_no_password)
    except (OSError, ssl.SSLError, ValueError) as error:
        raise RunError(
            f"{options.cert}, {options.key}: cannot be used as certificate and key: {error}",
            code="server.certificate.unusable",
        ) from error
    return context


def _no_password() -> str:
    raise ValueError("the key is encrypted; store it without a password, readable by its owner only")


def _address(options: Options, port: int) -> str:
    host = f"[{options.host}]" if ":" in options.host else options.host
    return f"http{'s' if options.cert else ''}://{host}:{port}/"
