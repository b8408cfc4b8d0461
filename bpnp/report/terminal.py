"""Tables for the terminal: every name and number stays whole in 80 columns."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

from rich import box
from rich.console import Console, ConsoleOptions
from rich.table import Table
from rich.text import Text

Paper = Literal["modelnet40", "megadepth"]  # data sets of the paper, whose printed rows can be shown
WIDTH = 80  # columns of the narrowest terminal; narrower ones wrap


def console() -> Console:
    """Standard output, at least `WIDTH` columns wide."""
    terminal = Console()
    terminal.width = max(terminal.width, WIDTH)
    return terminal


@dataclass(frozen=True)
class SplitTable:
    """A table that is split into several, one below the other, where its columns do not fit side by side.

    headers: of the number columns. groups: rows (name, cells), with a line between groups.
    """

    title: str
    headers: Sequence[str]
    groups: Sequence[Sequence[tuple[Text, Sequence[Text]]]]
    caption: str = ""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table | Text]:
        rows = [row for group in self.groups for row in group]
        name = min(max([9, *(len(label) for label, _ in rows)]), options.max_width // 3)
        parts: list[list[int]] = [[]]
        left = options.max_width - name - 2
        for i, header in enumerate(self.headers):
            width = 1 + max([*map(len, header.split("\n")), *(len(cells[i]) for _, cells in rows)])
            if width > left and parts[-1]:
                parts.append([])
                left = options.max_width - name - 2
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


def number(value: float | None) -> str:
    """Three significant digits in at most six characters: two digits below 0.01; "-" for none.

    >>> [number(value) for value in (12.34, 0.00126, 12345.6, None)]
    ['12.3', '0.0013', '12346', '-']
    """
    if value is None:
        return "-"
    size = abs(value)
    if size == 0 or not math.isfinite(value):
        return f"{value:g}"
    if 0.01 <= size < 999.5:
        return f"{value:#.3g}".rstrip(".")
    if 0.001 <= size < 0.01:
        return f"{value:.4f}"
    if 999.5 <= size < 99_999.5:
        return f"{value:.0f}"
    mantissa, exponent = f"{value:.{0 if size < 1e-9 else 1}e}".split("e")
    return f"{mantissa}e{int(exponent)}"
