"""What came of the parity checks, as a record and as a table."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from edge.report.rows import NO_VALUE, Table

TITLE = "Preprocessing parity: what the networks see, against a reference in float64"


@dataclass(frozen=True, slots=True)
class ParityCheck:
    """One comparison.

    Attributes:
        what: checked; model: ``float32``, ``INT8``, or empty where the check is of the frames.
        found: in words, with units; limit: likewise.
        passed: None where the pictures or the graph cannot tell.
        remedy: what to do; empty where it passed.
    """

    what: str
    model: str
    found: str
    limit: str
    passed: bool | None
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class ParityRecord:
    """All checks and the frames that they looked at."""

    checks: tuple[ParityCheck, ...]
    frame_ids: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether nothing failed."""
        return all(check.passed is not False for check in self.checks)

    @property
    def failures(self) -> tuple[ParityCheck, ...]:
        """Those that failed."""
        return tuple(check for check in self.checks if check.passed is False)

    def as_json(self) -> dict[str, Any]:
        """For report.json."""
        return {"passed": self.passed, "frames": list(self.frame_ids), "checks": [asdict(item) for item in self.checks]}


def parity_table(record: ParityRecord) -> Table:
    """The checks as a table."""
    verdicts = {True: "pass", False: "FAIL", None: "cannot tell"}
    rows = tuple(
        (item.what, item.model or NO_VALUE, item.found, item.limit, verdicts[item.passed], item.remedy or NO_VALUE)
        for item in record.checks
    )
    columns = ("check", "model", "found", "limit", "verdict", "remedy")
    return Table(TITLE, columns, rows, note=f"Looked at on frames {', '.join(record.frame_ids)}.")
