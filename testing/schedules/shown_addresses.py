"""Finds objects in sent data that are shown by their memory address, which no seed decides."""

from __future__ import annotations

import gc
import re

SHOWN = re.compile(rb" at 0x([0-9a-f]+)")
"""As the texts of objects have it whose class says nothing else, and those of functions and bound methods."""


def shown_address(body: bytes) -> str | None:
    """Of which class the object is whose address is shown in a value's bytes; None: of nothing that lives.

    To find out whether it lives takes milliseconds, and is done only where there is such a text. Objects that the
    collector does not know, such as those of `object` itself, are not found.

    >>> class Account: ...
    >>> account = Account()
    >>> shown_address(f"opened {account}".encode()), shown_address(b"<Account object at 0x10>")
    ('Account', None)
    """
    addresses = {int(number, 16) for number in SHOWN.findall(body)}
    if not addresses:
        return None
    return next((type(one).__qualname__ for one in gc.get_objects() if id(one) in addresses), None)
