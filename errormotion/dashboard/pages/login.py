"""The page that requests the token."""

from __future__ import annotations

import asyncio

from errormotion.dashboard.pages.page import Guarded

DELAY = 1.0
"""Delay of the answer to a wrong token, s."""


class Login(Guarded):
    """Request for the token; with the correct one this browser has access until the server ends."""

    public = True

    def get(self) -> None:
        """Show the form."""
        if self.context.access.accepts_session(self.get_cookie(self.context.cookie)):
            self.redirect("/")
            return
        self.show("login.html.j2", refused=False)

    async def post(self) -> None:
        """Check the token."""
        access = self.context.access
        if not access.accepts_token(self.get_body_argument("token", "")):
            await asyncio.sleep(DELAY)
            self.set_status(403)
            self.show("login.html.j2", refused=True)
            return
        options = {"httponly": True, "samesite": "Strict", "secure": access.secure}
        self.set_cookie(self.context.cookie, access.session, **options)  # type: ignore[arg-type]
        self.redirect("/")
