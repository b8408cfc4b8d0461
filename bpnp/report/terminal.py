"""Colours of results, and output on the terminal: lines, progress on stderr, and tables that fit in 80 columns."""

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

from rich import box
from rich.console import Console, ConsoleOptions
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

# Colours of runs and estimates, for the page and for figures: eight in each scheme. Their distance in CIE Lab from each
# other and from the text, the colour of the true pose, is at least 27 for readers with normal vision, protanopia and
# deuteranopia and 21 with tritanopia, and their contrast to the background is at least 3. Estimates also differ by
# their dashes.
LIGHT = ("#002ed0", "#c68500", "#08a76d", "#91290f", "#977dea", "#af80b7", "#58006e", "#306860")
DARK = ("#12cdff", "#ffb006", "#009b6b", "#986e9f", "#f3d783", "#cd5e1c", "#8020ff", "#887bff")
# Colours of the page, light and dark.
INKS = {
    "background": ("#ffffff", "#14171c"),
    "text": ("#1b1f24", "#e6e8eb"),
    "quiet": ("#59626d", "#a0a8b3"),
    "line": ("#d5dae0", "#363c45"),
    "panel": ("#f5f6f8", "#1d2128"),
    "focus": ("#0b57d0", "#8ab4f8"),
    "wrong": ("#b3261e", "#ff8a80"),
} | {f"c{i}": inks for i, inks in enumerate(zip(LIGHT, DARK, strict=True))}
QUIET = INKS["quiet"][0]
VERDICTS = {"confident": LIGHT[2], "ambiguous": LIGHT[1], "failed": LIGHT[3]}
DASHES = ((), (6.0, 3.0), (2.0, 2.0), (9.0, 3.0, 2.0, 3.0))
Paper = Literal["modelnet40", "megadepth"]  # data sets of the paper, whose published rows can be shown
WIDTH = 80  # columns; narrower terminals wrap


class Terminal(Console):
    """Console of rich that raises BrokenPipeError if its reader is gone, instead of exiting with status 1."""

    def on_broken_pipe(self) -> None:
        """Raise the error again; rich calls this while it handles it."""
        raise  # noqa: PLE0704


def say(line: object, *, to: Console | None = None) -> None:
    """Print a line without wrapping or colours, by default to standard output."""
    (to or Terminal()).print(str(line), markup=False, emoji=False, highlight=False, soft_wrap=True)


def progress(*, items: bool = True, quiet: bool = False) -> Progress:
    """Return a progress display on stderr, removed when its block ends."""
    columns = (BarColumn(), MofNCompleteColumn()) if items else ()
    console = Terminal(stderr=True, quiet=quiet, force_jupyter=False)  # a notebook's needs ipywidgets
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        *columns,
        TimeElapsedColumn(),
        console=console,
        transient=True,
        disable=quiet or not sys.stderr.isatty(),  # FORCE_COLOR makes rich take any stream for a terminal
    )


@contextmanager
def count_items(what: str, total: int, *, quiet: bool = False) -> Iterator[Callable[[str], None]]:
    """Show how many items are done, on stderr: a bar on a terminal, elsewhere, such as in a pipe, a line each.

    Yield the function to call with a few words on each item that is done. `what` names the work, such as "localizing".
    """
    with progress(quiet=quiet) as shown:
        bar = shown.add_task(what, total=total)

        def finish(words: str) -> None:
            shown.update(bar, description=words, advance=1)
            if shown.disable:
                say(f"{shown.tasks[bar].completed:.0f}/{total} {words}", to=shown.console)

        yield finish


def console(*, json: bool = False, quiet: bool = False) -> Console:
    """Return a console on standard output, at least `WIDTH` columns wide."""
    terminal = Terminal(stderr=json, quiet=quiet)
    terminal.width = max(terminal.width, WIDTH)
    return terminal


@dataclass(frozen=True)
class SplitTable:
    """Table that is split into several, one below the other, where its columns do not fit side by side.

    Names are folded between words before it is split.
    """

    title: str
    headers: Sequence[str]  # headers of the number columns
    # Groups of rows (name, cells), with a line between groups. Cells may have several lines.
    groups: Sequence[Sequence[tuple[Text, Sequence[Text]]]]
    caption: str = ""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table | Text]:
        rows = [row for group in self.groups for row in group]
        widths = [
            1 + max(len(text) for it in (header, *(cells[i].plain for _, cells in rows)) for text in it.split("\n"))
            for i, header in enumerate(self.headers)
        ]
        longest = max((len(label) for label, _ in rows), default=0)
        longest_word = max((len(word) for label, _ in rows for word in label.plain.split()), default=0)
        room = options.max_width - 2
        name = min(longest, room - sum(widths))
        if name < longest_word:  # the columns do not fit
            name = min(max(longest, 9), options.max_width // 3)
        parts: list[list[int]] = [[]]
        left = room - name
        for i, width in enumerate(widths):
            if width > left and parts[-1]:
                parts.append([])
                left = room - name
            parts[-1].append(i)
            left -= width
        for part in parts:
            title = self.title or None if part is parts[0] else None
            table = Table(title=title, box=box.SIMPLE_HEAD, padding=0, pad_edge=False)
            table.add_column("", overflow="fold", width=name)
            for i in part:
                table.add_column(self.headers[i], justify="right", no_wrap=True)
            for group in self.groups:
                for label, cells in group:
                    table.add_row(label, *(cells[i] for i in part))
                table.add_section()
            yield table
        if self.caption:
            yield Text(self.caption, "dim italic")


def shorten(names: Sequence[str], width: int) -> list[str]:
    """Cut names to a width: their heads, an ellipsis, and their tails, so that as many as possible stay different.

    >>> from bpnp.report.terminal import shorten
    >>> shorten(["cam0/000001.jpg", "cam1/000001.jpg", "a.jpg"], 9)
    ['cam0….jpg', 'cam1….jpg', 'a.jpg']
    """

    def cut(name: str, head: int) -> str:
        return name if len(name) <= width else f"{name[:head]}…{name[len(name) - (width - 1 - head) :]}"

    heads = sorted(range(width), key=lambda head: abs(head - (width - 1) // 2))
    best = max(heads, key=lambda head: len({cut(name, head) for name in names}))
    return [cut(name, best) for name in names]


def format_fixed(values: Sequence[float | int]) -> list[str]:
    """Write numbers of one kind, such as coordinates, without exponents: three decimals, more if all are small.

    >>> from bpnp.report.terminal import format_fixed
    >>> format_fixed([500000.25, 5123456.789, 0]), format_fixed([0.02, -1.5, 0])
    (['500000.250', '5123456.789', '0.000'], ['0.02000', '-1.50000', '0.00000'])
    """
    largest = max([abs(value) for value in values if math.isfinite(value)], default=0.0)
    before = math.floor(math.log10(largest)) + 1 if largest else 1
    return [f"{value:.{max(6 - before, 3)}f}" for value in values]


def number(value: float | None, *, short: bool = False) -> str:
    """Format a number with three significant digits in at most six characters.

    Below 0.01 there are two digits, and with `short`, for a narrow column, below 1. None gives "-".

    >>> from bpnp.report.terminal import number
    >>> [number(value) for value in (12.34, 0.00126, 0.00998, 12345.6, None)]
    ['12.3', '0.0013', '0.010', '12346', '-']
    >>> [number(value, short=True) for value in (12.34, 0.0126)]
    ['12.3', '0.013']
    """
    if value is None:
        return "-"
    size = abs(value)
    if size == 0 or not math.isfinite(value):
        return f"{value:g}"
    if 0.01 <= size < 999.5:
        return f"{value:#.{2 if short and size < 0.995 else 3}g}".rstrip(".")
    if 0.001 <= size < 0.01:
        return f"{value:.{4 if size < 0.00995 else 3}f}"
    if 999.5 <= size < 99_999.5:
        return f"{value:.0f}"
    mantissa, exponent = f"{value:.{0 if size < 1e-9 else 1}e}".split("e")
    return f"{mantissa}e{int(exponent)}"
