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
    def refusing(self, where: str, number: int, reason: str = "", *others: type[Exception]) -> Iterator[None]:
        """Do `refuse` for the record whose reading fails inside.

        Parameters
        ----------
        reason, others
            For failures other than a `RecordFault`.
        """
        try:
            yield
        except RecordFault as fault:
            self.refuse(fault, where, number)
        except others as error:
            self.refuse(RecordFault(reason, str(error)), where, number)
