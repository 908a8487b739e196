"""A task for other processes that ends its process."""

import os
from typing import NoReturn


def end(*_: object) -> NoReturn:
    """End the process at once."""
    os._exit(1)
