"""A progress line on stderr, shown for work that takes longer than two seconds."""

import threading
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

PATIENCE = 2.0  # seconds


class SlowProgress:
    """A line with what is going on and since when, and a bar if there are several items; gone when the block ends."""

    def __init__(self, description: str, *, total: int = 1, console: Console | None = None) -> None:
        bar = (BarColumn(), MofNCompleteColumn()) if total > 1 else ()
        columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), *bar, TimeElapsedColumn())
        self._progress = Progress(*columns, console=console or Console(stderr=True), transient=True)
        self._task = self._progress.add_task(description, total=total)
        self._timer = threading.Timer(PATIENCE, self._progress.start)
        self._timer.daemon = True

    def __enter__(self) -> "SlowProgress":
        self._timer.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._timer.cancel()
        self._timer.join()
        if self._progress.live.is_started:
            self._progress.stop()

    def describe(self, text: str) -> None:
        """What is going on now."""
        self._progress.update(self._task, description=text)

    def advance(self, items: int = 1) -> None:
        """So many items are done."""
        self._progress.advance(self._task, items)
