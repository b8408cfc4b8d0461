"""A table for the terminal that fits in 80 columns with its names and numbers whole."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich import box
from rich.console import Console, ConsoleOptions
from rich.table import Table
from rich.text import Text

WIDTH = 80  # columns of the narrowest terminal; narrower ones wrap


@dataclass(frozen=True)
class FittedTable:
    """A table that is broken into several, side by side one below the other, where its columns do not fit.

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
        for number, part in enumerate(parts):
            title = self.title if number == 0 and self.title else None
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
