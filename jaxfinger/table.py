"""Tables of results: lists of dictionaries that print as tables in a terminal and in a notebook."""

from collections.abc import Iterable
from html import escape
from typing import Any


class Table(list[dict[str, Any]]):
    """List of rows, dictionaries with the same keys in order; SI units, in a column where they differ by row."""

    def __init__(self, rows: Iterable[dict[str, Any]] = ()):
        super().__init__(rows)

    @property
    def columns(self) -> list[str]:
        """Keys of the rows, in order of first occurrence."""
        return list(dict.fromkeys(k for row in self for k in row))

    def column(self, name: str) -> list[Any]:
        """Values of one column; None where a row lacks it.

        Raises:
            KeyError: there is no such column; the message lists the columns.
        """
        if name not in self.columns:
            raise KeyError(f"no column {name!r}; there are {', '.join(self.columns)}")
        return [row.get(name) for row in self]

    def to_dataframe(self):
        """Rows as a pandas DataFrame.

        Raises:
            ImportError: pandas is not installed.
        """
        # pandas is not a dependency, since only this method needs it.
        import pandas  # pyright: ignore[reportMissingImports]

        return pandas.DataFrame(list(self), columns=self.columns)

    def __repr__(self) -> str:
        cells = [self.columns, *([_text(row.get(c)) for c in self.columns] for row in self)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells)

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{escape(c)}</th>" for c in self.columns)
        body = "".join(
            "<tr>" + "".join(f"<td>{escape(_text(row.get(c)))}</td>" for c in self.columns) + "</tr>" for row in self
        )
        return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _text(value: Any) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
