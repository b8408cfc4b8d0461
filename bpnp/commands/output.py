"""What commands print: lines as they are, and progress on stderr."""

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn


def say(line: object, *, to: Console | None = None) -> None:
    """A line as it is: not wrapped, not coloured."""
    (to or Console()).print(str(line), markup=False, highlight=False, soft_wrap=True)


def progress(*, items: bool = True) -> Progress:
    """What is going on and since when, and of several items how many are done; gone when the block ends."""
    columns = (BarColumn(), MofNCompleteColumn()) if items else ()
    console = Console(stderr=True)
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        *columns,
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=not console.is_interactive,
    )
