"""Counts the records that readers of several files reject."""

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
        Name of the dataset, for messages.
    strict
        Stop at the first damaged record.
    """

    name: str
    report: ReadReport
    strict: bool

    @classmethod
    def quiet(cls, path: Path) -> Self:
        """An account for a quick look at a dataset; its counts are not reported."""
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
        """Call `refuse` if reading a record fails in the body.

        Parameters
        ----------
        number
            None: number of the report's newest line.
        reason, others
            Reason and exception types for failures other than a `RecordFault`.
        """
        damages: tuple[type[Exception], ...] = (RecordFault, *others)
        try:
            yield
        except damages as error:
            fault = error if isinstance(error, RecordFault) else RecordFault(reason, str(error))
            self.refuse(fault, where, self.report.line_count if number is None else number)
