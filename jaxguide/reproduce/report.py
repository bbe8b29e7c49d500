"""The report of a reproduction: rows of computed values beside reference and printed ones.

Host-side; light to import.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from rich import box
from rich.console import Console, Group
from rich.table import Table
from rich.text import Text


@dataclasses.dataclass
class Row:
    """One computed number.

    It is judged if it has a reference and a tolerance, and then passes when

        |computed - reference| <= max(tolerance, relative |reference|).

    Otherwise it is shown only. The printed value is never judged: a paper may be wrong.

    **Arguments:**

    - `name`: of the number.
    - `computed`: the value found here.
    - `reference`: an independent value held to be true.
    - `printed`: the value in the publication.
    - `tolerance`: largest absolute deviation from the reference, in `unit`.
    - `relative`: largest relative deviation from the reference.
    - `unit`, `note`: shown beside.
    """

    name: str
    computed: Any
    reference: Any = None
    printed: Any = None
    tolerance: float | None = None
    relative: float | None = None
    unit: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        self.computed = float(self.computed)
        for field in ("reference", "printed", "tolerance", "relative"):
            value = getattr(self, field)
            setattr(self, field, None if value is None else float(value))

    @property
    def judged(self) -> bool:
        """Whether there is a reference, and a tolerance to hold the value to."""
        has_tolerance = self.tolerance is not None or self.relative is not None
        return self.reference is not None and has_tolerance

    @property
    def deviation(self) -> float | None:
        """Computed minus reference, or minus printed where there is no reference."""
        against = self.printed if self.reference is None else self.reference
        return None if against is None else self.computed - against

    @property
    def allowed(self) -> float | None:
        """Largest deviation from the reference at which the row passes."""
        if self.reference is None or not self.judged:
            return None
        return max(self.tolerance or 0.0, (self.relative or 0.0) * abs(self.reference))

    @property
    def passed(self) -> bool:
        """Whether the value is within its tolerance; true of a row that is not judged."""
        deviation, allowed = self.deviation, self.allowed
        if deviation is None or allowed is None:
            return True
        return abs(deviation) <= allowed  # false for NaN

    def to_dict(self) -> dict[str, Any]:
        """Fields and judgement, for JSON."""
        computed = {key: getattr(self, key) for key in ("deviation", "allowed", "judged", "passed")}
        return jsonable(dataclasses.asdict(self) | computed)


@dataclasses.dataclass
class Section:
    """Rows under one title, with a paragraph of explanation."""

    title: str
    text: str = ""
    rows: list[Row] = dataclasses.field(default_factory=list)

    def add(self, name: str, computed: Any, reference: Any = None, **options: Any) -> Row:
        """Appends a `Row`; the options are its other fields."""
        row = Row(name, computed, reference, **options)
        self.rows.append(row)
        return row

    @property
    def passed(self) -> bool:
        """Whether every row passes."""
        return all(row.passed for row in self.rows)

    def to_dict(self) -> dict[str, Any]:
        """Title, text and rows, for JSON."""
        rows = [row.to_dict() for row in self.rows]
        return {"title": self.title, "text": self.text, "passed": self.passed, "rows": rows}

    def __rich__(self) -> Group:
        numbers = {
            "computed": [_number(row.computed) for row in self.rows],
            "reference": [_number(row.reference) for row in self.rows],
            "printed": [_number(row.printed) for row in self.rows],
            "deviation": [_number(row.deviation, 2) for row in self.rows],
            "allowed": [_number(row.allowed, 2) for row in self.rows],
        }
        numbers = {header: cells for header, cells in numbers.items() if any(cells)}
        table = Table(box=box.SIMPLE_HEAD, title=self.title, title_justify="left")
        table.add_column("")
        for header in numbers:
            table.add_column(header, justify="right", no_wrap=True)
        table.add_column("")
        for i, row in enumerate(self.rows):
            # Text, not str: names such as "case [1]" are no markup.
            name = Text(f"{row.name} [{row.unit}]" if row.unit else row.name)
            if row.note:
                name.append(f"\n{row.note}", style="dim")
            verdict = Text("ok", "green") if row.passed else Text("OUT", "bold red")
            cells = (column[i] for column in numbers.values())
            table.add_row(name, *cells, verdict if row.judged else "")
        return Group(*([Text(self.text)] if self.text else []), table)


@dataclasses.dataclass
class Report:
    """A reproduction: sections of rows, the figures written, and seconds spent by stage.

    `extra` holds anything else worth keeping; it is in the JSON only.
    """

    title: str
    sections: list[Section] = dataclasses.field(default_factory=list)
    figures: list[str] = dataclasses.field(default_factory=list)
    timings: dict[str, float] = dataclasses.field(default_factory=dict)
    extra: dict[str, Any] = dataclasses.field(default_factory=dict)

    def section(self, title: str, text: str = "") -> Section:
        """Appends a section and returns it."""
        self.sections.append(Section(title, text))
        return self.sections[-1]

    @property
    def rows(self) -> list[Row]:
        """The rows of all sections."""
        return [row for section in self.sections for row in section.rows]

    @property
    def passed(self) -> bool:
        """Every judged row within its tolerance, and at least one judged."""
        judged = [row for row in self.rows if row.judged]
        return len(judged) > 0 and all(row.passed for row in judged)

    def to_dict(self) -> dict[str, Any]:
        """For JSON: plain numbers, and null for NaN and infinities."""
        return jsonable(
            {
                "title": self.title,
                "passed": self.passed,
                "sections": [section.to_dict() for section in self.sections],
                "figures": self.figures,
                "timings": self.timings,
                "extra": self.extra,
            }
        )

    def __rich__(self) -> Group:
        parts: list[Any] = [Text(self.title, style="bold"), Text(), *self.sections]
        if self.timings:
            spent = ", ".join(f"{name} {s:.2f} s" for name, s in self.timings.items())
            parts.append(Text(f"Time: {spent}."))
        if self.figures:
            parts.append(Text("Figures: " + ", ".join(self.figures)))
        judged = [row for row in self.rows if row.judged]
        out = sum(not row.passed for row in judged)
        parts.append(Text(f"{len(judged) - out} of {len(judged)} rows within tolerance."))
        return Group(*parts)

    def print(self, console: Console | None = None) -> None:
        """Prints the report as tables."""
        console = console or Console()
        if not console.is_terminal:
            console.width = max(console.width, 120)  # a file need not be 80 columns wide
        console.print(self)


def jsonable(tree: Any) -> Any:
    """`tree` with arrays as lists, and NaN and infinities, which JSON lacks, as null."""
    if isinstance(tree, dict):
        return {str(key): jsonable(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [jsonable(value) for value in tree]
    if tree is None or isinstance(tree, str | bool | int):
        return tree
    if isinstance(tree, float):
        return tree if math.isfinite(tree) else None
    if hasattr(tree, "__array__"):
        return jsonable(np.asarray(tree).tolist())
    return str(tree)


def _number(value: float | None, digits: int = 10) -> str:
    return "" if value is None else f"{value:.{digits}g}"
