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

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
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
            title, caption = (text or None for text in (self.title, self.caption))
            table = Table(
                title=title if number == 0 else None, caption=caption if part is parts[-1] else None,
                box=box.SIMPLE_HEAD, padding=0, caption_justify="left", pad_edge=False,
            )  # fmt: skip
            table.add_column("", overflow="fold", width=name)
            for i in part:
                table.add_column(self.headers[i], justify="right", no_wrap=True)
            for group in self.groups:
                for label, cells in group:
                    table.add_row(label, *(cells[i] for i in part))
                table.add_section()
            yield table
