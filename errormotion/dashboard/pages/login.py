"""The page that asks for the token."""

from __future__ import annotations

import asyncio

from errormotion.dashboard.pages.page import Guarded

DELAY = 1.0
"""Time until a wrong token is refused, s."""


class Login(Guarded):
    """Asks for the token; the right one opens the dashboard to this browser until the server ends."""

    public = True

    def get(self) -> None:
        """Show the form."""
        if self.context.access.knows(self.get_cookie(self.context.cookie)):
            self.redirect("/")
            return
        self.show("login.html.j2", refused=False)

    async def post(self) -> None:
        """Compare the token."""
        access = self.context.access
        if not access.opens(self.get_body_argument("token", "")):
            await asyncio.sleep(DELAY)
            self.set_status(403)
            self.show("login.html.j2", refused=True)
            return
        options = {"httponly": True, "samesite": "Strict", "secure": access.secure}
        self.set_cookie(self.context.cookie, access.session, **options)  # type: ignore[arg-type]
        self.redirect("/")
