"""The page that requests the token."""

from __future__ import annotations

import asyncio

from tornado.web import HTTPError

from errormotion.dashboard.pages.page import Guarded
from errormotion.datasets.files.reading import parse_json

DELAY = 1.0
"""Delay of the answer to a wrong token, s."""


class Login(Guarded):
    """Request for the token; with the correct one this browser has access until the server ends."""

    public = True

    async def get(self) -> None:
        """Show the form."""
        known = self.context.access.accepts_session(self.get_cookie(self.context.cookie))
        if known and not self.context.control:  # for control the token can be presented again
            self.redirect("/")
            return
        await self.show("login.html.j2", refused=False)

    async def post(self) -> None:
        """Check the token."""
        access, as_json = self.context.access, "json" in self.request.headers.get("Content-Type", "")
        if not access.accepts_token(self._token() if as_json else self.get_body_argument("token", "")):
            await self.ending_with_the_client(asyncio.sleep(DELAY))
            if as_json:
                raise HTTPError(403, reason="The token is wrong.")
            self.set_status(403)
            await self.show("login.html.j2", refused=True)
            return
        options = {"httponly": True, "samesite": "Strict", "secure": access.secure}
        self.set_cookie(self.context.cookie, access.session, **options)  # type: ignore[arg-type]
        if as_json:
            self.finish({"control": access.control_for(self.request.headers.get("Host", ""))})
        else:  # without a script: for reading only
            self.redirect("/")

    def _token(self) -> str:
        try:
            found = parse_json(self.request.body)
        except ValueError:
            return ""
        token = found.get("token") if isinstance(found, dict) else None
        return token if isinstance(token, str) else ""
