"""The load of the server: how many requests of a client are in progress at a time, and how many it may make.

A client is an address; a network of IPv6 counts as one. Each has separate shares for what needs no session, for
results, and for the pages from which something is stopped, so that one does not delay another. Requests to stop are not
counted.
"""

from __future__ import annotations

import ipaddress
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, get_args

Share = Literal["open", "reading", "stopping"]

AT_ONCE = 32
"""Number of requests of one client in progress at a time; a browser makes six, and several may be on one computer."""
MOST = 128
"""Number of requests of all clients in progress at a time."""
RATE, BURST = 400.0, 800.0
"""Requests of one client per second in the long term, and at a time after a pause."""
KEPT = 1000
"""Number of clients whose requests are counted."""
REFUSAL_DELAY = 1.0
"""Delay of the answer to a request that exceeds a share, s."""


@dataclass
class _Client:
    busy: int = 0
    left: float = BURST
    since: float = 0.0


@dataclass
class Load:
    """The requests of all clients; ``clock`` returns a time in s."""

    clock: Callable[[], float] = time.monotonic
    clients: dict[tuple[str, Share], _Client] = field(default_factory=dict)
    total: dict[Share, int] = field(default_factory=lambda: dict.fromkeys(get_args(Share), 0))

    def begin(self, address: str, share: Share) -> bool:
        """Count a request, and return whether it may be served; then `end` must be called."""
        now, key = self.clock(), (client_of(address), share)
        client = self.clients.pop(key, None) or _Client(since=now)
        self.clients[key] = client  # the last one
        self._forget()
        client.left, client.since = min(BURST, client.left + RATE * (now - client.since)), now
        if client.left < 1.0 or client.busy >= AT_ONCE or self.total[share] >= MOST:
            return False
        client.left -= 1.0
        client.busy += 1
        self.total[share] += 1
        return True

    def end(self, address: str, share: Share) -> None:
        """State that a request has been answered."""
        self.total[share] -= 1
        client = self.clients.get((client_of(address), share))
        if client is not None:
            client.busy -= 1

    def _forget(self) -> None:
        if len(self.clients) > KEPT:
            idle = next((key for key, each in self.clients.items() if not each.busy), None)
            if idle is not None:
                del self.clients[idle]


def client_of(address: str) -> str:
    """Return the client of an address: itself, or its network of 64 bits for IPv6."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return address
    if isinstance(found, ipaddress.IPv4Address):
        return str(found)
    if found.ipv4_mapped is not None:
        return str(found.ipv4_mapped)
    return str(ipaddress.ip_network((found, 64), strict=False))
