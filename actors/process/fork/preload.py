"""Importing what actors need before the first fork: the entry point, the program itself, modules by name or path."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.util
import os
import socket
import sys
import traceback
import types
from collections.abc import Callable

MAIN_NAME = "__mp_main__"  # the name scripts already know from multiprocessing


def find_entry(entry: str) -> Callable[[socket.socket, int], int | None]:
    """Import the function that "module:function" names."""
    module, _, function = entry.partition(":")
    found: Callable[[socket.socket, int], int | None] = getattr(importlib.import_module(module), function)
    return found


def load(what: str) -> None:
    """Import a module by name, or a file by its path (as the module named like the file)."""
    if os.sep not in what and not what.endswith(".py"):
        importlib.import_module(what)
        return
    name = os.path.splitext(os.path.basename(what))[0]
    if name in sys.modules:
        known = getattr(sys.modules[name], "__file__", None)
        if known is None or not os.path.samefile(known, what):
            raise ImportError(f"another module is called {name} already ({known or 'built in'})")
        return
    spec = importlib.util.spec_from_file_location(name, what)
    if spec is None or spec.loader is None:
        raise ImportError(f"{what} is not a Python file")
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise


def load_main(main: str, is_path: bool) -> None:
    """Run the parent's program under another name, so that classes defined in it are found as `__main__:X`.

    As multiprocessing's spawn does, but the module's namespace is the one its functions see: `runpy` hands out a copy.
    """
    module = types.ModuleType(MAIN_NAME)
    if is_path:
        module.__file__ = main
        with open(main, "rb") as file:
            code = compile(file.read(), main, "exec", dont_inherit=True)
    else:
        spec = importlib.util.find_spec(main)
        if spec is None or not isinstance(spec.loader, importlib.abc.InspectLoader):
            raise ImportError(f"no module named {main}")
        module.__file__, module.__package__ = spec.origin, spec.parent
        found = spec.loader.get_code(main)
        if found is None:
            raise ImportError(f"{main} has no Python code")
        code = found
    replaced = sys.modules["__main__"]
    sys.modules["__main__"] = sys.modules[MAIN_NAME] = module
    try:
        exec(code, module.__dict__)
    except BaseException:
        sys.modules["__main__"] = replaced
        del sys.modules[MAIN_NAME]
        raise


def attempt(load_it: Callable[[], None]) -> str:
    """Run one import; what went wrong, or an empty string."""
    try:
        load_it()
    except BaseException as error:  # a module may well call sys.exit(): that must not end the server
        frames = traceback.extract_tb(error.__traceback__)
        where = f" ({frames[-1].filename}:{frames[-1].lineno})" if frames else ""
        return f"{type(error).__name__}: {error}{where}"
    return ""
