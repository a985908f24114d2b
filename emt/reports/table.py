"""A table once, in every format: terminal text, Markdown, LaTeX, CSV and JSON."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

Format = Literal["text", "markdown", "latex", "csv", "json"]
FORMATS: tuple[Format, ...] = ("text", "markdown", "latex", "csv", "json")


@dataclass(frozen=True)
class Column:
    """A column: its key in every row, its heading, and whether its cells are numbers (aligned right)."""

    key: str
    heading: str
    number: bool = False


@dataclass(frozen=True)
class Table:
    """Rows of printable cells, with the plain values beside them for machines.

    A cell is found by the column's key; `values` of a row holds unformatted numbers for CSV and JSON.
    """

    title: str
    columns: Sequence[Column]
    rows: Sequence[dict[str, str]]
    values: Sequence[dict[str, Any]]
    notes: Sequence[str] = ()

    def render(self, fmt: Format) -> str:
        """The table as text of the given format; text ends with a newline."""
        return {
            "text": self._text,
            "markdown": self._markdown,
            "latex": self._latex,
            "csv": self._csv,
            "json": self._json,
        }[fmt]()

    def _cells(self) -> list[list[str]]:
        return [[row.get(column.key, "") for column in self.columns] for row in self.rows]

    def _text(self) -> str:
        cells = [[c.heading for c in self.columns], *self._cells()]
        widths = [max(len(row[k]) for row in cells) for k in range(len(self.columns))]

        def line(row):
            parts = [
                cell.rjust(width) if column.number else cell.ljust(width)
                for cell, width, column in zip(row, widths, self.columns, strict=True)
            ]
            return "  ".join(parts).rstrip()

        rule = "  ".join("-" * width for width in widths)
        return "\n".join([self.title, line(cells[0]), rule, *map(line, cells[1:]), *self.notes]) + "\n"

    def _markdown(self) -> str:
        def line(row):
            return "| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |"

        rule = "|" + "|".join("---:" if column.number else "---" for column in self.columns) + "|"
        body = [line([c.heading for c in self.columns]), rule, *map(line, self._cells())]
        notes = [f"\n{note}" for note in self.notes]
        return "\n".join([f"**{self.title}**", "", *body, *notes]) + "\n"

    def _latex(self) -> str:
        align = "".join("r" if column.number else "l" for column in self.columns)

        def line(row):
            return "  " + " & ".join(map(latex_escape, row)) + r" \\"

        return (
            "\n".join(
                [
                    r"% needs \usepackage{booktabs}",
                    r"\begin{table}",
                    r"\centering",
                    rf"\caption{{{latex_escape(self.title)}}}",
                    rf"\begin{{tabular}}{{{align}}}",
                    r"\toprule",
                    line([c.heading for c in self.columns]),
                    r"\midrule",
                    *map(line, self._cells()),
                    r"\bottomrule",
                    r"\end{tabular}",
                    *[rf"\par\footnotesize {latex_escape(note)}" for note in self.notes],
                    r"\end{table}",
                ]
            )
            + "\n"
        )

    def _csv(self) -> str:
        stream = io.StringIO()
        names = list(dict.fromkeys(name for row in self.values for name in row))
        writer = csv.DictWriter(stream, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.values)
        return stream.getvalue()

    def _json(self) -> str:
        return json.dumps({"title": self.title, "rows": list(self.values)}, indent=2, ensure_ascii=False) + "\n"


LATEX_SIGNS = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$", "²": r"$^2$", "–": "--", "α": r"$\alpha$",
    "σ": r"$\sigma$", "θ": r"$\theta$",
}  # fmt: skip


def latex_escape(text: str) -> str:
    """Text with every sign that LaTeX would interpret written out."""
    return "".join(LATEX_SIGNS.get(sign, sign) for sign in text)
