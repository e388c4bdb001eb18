"""Where readers of several files put what they had to refuse."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from slam.datasets.dataset import ReadReport, RecordFault
from slam.errors import BadRecordError

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Account:
    """The report of one pass, and whether a damaged record ends it.

    Attributes
    ----------
    name
        Of the dataset, for messages.
    report
        Gets the counts.
    strict
        Stop at the first damaged record.
    """

    name: str
    report: ReadReport
    strict: bool

    @classmethod
    def quiet(cls, path: Path) -> Self:
        """One for a look at a dataset, whose counts nobody reads."""
        return cls(path.name, ReadReport(), strict=False)

    def refuse(self, fault: RecordFault, where: str, number: int) -> None:
        """Count a damaged record, or stop at it.

        Parameters
        ----------
        where, number
            The file, and the line or record in it.

        Raises
        ------
        BadRecordError
            Under ``strict``.
        """
        if self.strict:
            raise BadRecordError(
                f"{self.name}: {where}, record {number}: {fault}; read without --strict to count and skip it"
            )
        self.report.drop(fault.reason, number)
        log.debug("%s: %s, record %d: %s", self.name, where, number, fault)

    @contextmanager
    def refusing(
        self, where: str, number: int | None = None, reason: str = "", *others: type[Exception]
    ) -> Iterator[None]:
        """Do `refuse` for the record whose reading fails inside.

        Parameters
        ----------
        number
            None for that of the report's newest line by then.
        reason, others
            For failures other than a `RecordFault`.
        """
        damages: tuple[type[Exception], ...] = (RecordFault, *others)
        try:
            yield
        except damages as error:
            fault = error if isinstance(error, RecordFault) else RecordFault(reason, str(error))
            self.refuse(fault, where, self.report.line_count if number is None else number)
