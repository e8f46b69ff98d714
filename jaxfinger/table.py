"""Rows of a result: a list of dictionaries that prints as a table, in a terminal and in a notebook."""

from collections.abc import Iterable
from html import escape
from typing import Any


class Table(list[dict[str, Any]]):
    """Rows with the same keys, in order. SI units, named in a column where they differ from row to row."""

    def __init__(self, rows: Iterable[dict[str, Any]] = ()):
        super().__init__(rows)

    @property
    def columns(self) -> list[str]:
        """The keys of the rows."""
        return list(dict.fromkeys(k for row in self for k in row))

    def column(self, name: str) -> list[Any]:
        """One column; None where a row lacks it.

        Raises:
            KeyError: there is no such column; it says which there are.
        """
        if name not in self.columns:
            raise KeyError(f"no column {name!r}; there are {', '.join(self.columns)}")
        return [row.get(name) for row in self]

    def to_dataframe(self):
        """The rows as a pandas DataFrame, where pandas is installed."""
        # Not a dependency: whoever asks for a DataFrame has it.
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
