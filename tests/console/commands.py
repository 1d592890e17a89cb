"""The command line in a process of its own, for the tests."""

from tests.launched import python


async def holdfast(*arguments: object) -> tuple[int, str, str]:
    """The command in a process of its own: exit status, output, errors."""
    done = await python("-m", "holdfast.console.cli", *arguments, timeout=60)
    return done.returncode, done.stdout, done.stderr
