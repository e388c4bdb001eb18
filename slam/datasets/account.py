"""Where readers of several files put what they had to refuse."""

from __future__ import annotations

import logging
from dataclasses import dataclass

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
