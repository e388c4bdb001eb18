"""Runs on Dask: a local cluster of one process with any number of slots, or any scheduler."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from slam.comparison.isolation import STOPPING, Outcome
from slam.comparison.perform import Row, perform, record_drive, row_of
from slam.comparison.run import Run
from slam.comparison.runs import Source
from slam.errors import ScanweaveError
from slam.storage.map_identity import current_versions

if TYPE_CHECKING:
    from distributed import Client

_CONNECT_S = 10.0
_LOOPBACK = "127.0.0.1:0"  # Dask requires a status server; it must not be reachable from outside


def check_installed() -> None:
    """Check that the additional packages for comparisons are installed.

    Raises
    ------
    ScanweaveError
        If one is missing; the message says how to install it.
    """
    try:
        import dask

        # Read once, when distributed is first imported: Dask's own log messages are of no interest to users.
        dask.config.set({"logging.distributed": "error"})
        import distributed  # noqa: F401
        import psutil  # noqa: F401
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise ScanweaveError(
            f"compare needs {error.name}; install it with: pip install 'scanweave[compare]'"
        ) from error


@contextmanager
def client_of(workers: int, scheduler: str | None) -> Iterator[Client]:
    """A Dask client, on its own cluster if no scheduler is given.

    Raises
    ------
    ScanweaveError
        If the scheduler does not answer, has no workers, or they run another version of the code.
    """
    from distributed import Client

    if scheduler is None:
        with _local_client(workers) as client:
            yield client
        return
    try:
        client = Client(scheduler, timeout=_CONNECT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as error:
        raise ScanweaveError(
            f"no Dask scheduler answers at {scheduler} ({error}); start one with 'dask scheduler'"
        ) from error
    with client:
        _check_workers(client, scheduler)
        yield client


@contextmanager
def _local_client(workers: int) -> Iterator[Client]:
    """A client of a cluster in this process; slots are threads that wait for the processes of their runs."""
    import dask
    from distributed import Client, LocalCluster

    try:
        with (
            TemporaryDirectory() as scratch,
            dask.config.set({"temporary-directory": scratch}),
            LocalCluster(  # type: ignore[no-untyped-call]
                n_workers=1,
                threads_per_worker=workers,
                processes=False,
                dashboard_address=_LOOPBACK,
                worker_dashboard_address=_LOOPBACK,
                memory_limit=0,
                silence_logs=logging.CRITICAL,
            ) as cluster,
            Client(cluster) as client,  # type: ignore[no-untyped-call]
        ):
            try:
                yield client
            finally:
                STOPPING.set()  # threads cannot be interrupted: closing would wait for the end of their runs
    finally:
        STOPPING.clear()


def _check_workers(client: Client, scheduler: str) -> None:
    """Reject a cluster that cannot do the work."""
    try:
        codes: Mapping[str, Any] = client.run(current_versions, on_error="return")
    except Exception as error:
        raise ScanweaveError(f"the workers of {scheduler} do not answer: {error}") from error
    if not codes:
        raise ScanweaveError(f"{scheduler} has no workers; start some with 'dask worker {scheduler}'")
    own = current_versions()
    for address, code in codes.items():
        if code != own:
            reported = "no scanweave" if isinstance(code, Exception) else f"version {code.get('code')}"
            raise ScanweaveError(
                f"worker {address} has {reported}, here is {own['code']}; install the same on all of them"
            )


def run_all(
    client: Client,
    runs: Sequence[Run],
    sources: Sequence[Source],
    root: Path,
    on_row: Callable[[Row], None],
) -> list[Row]:
    """Do runs on a cluster; each returns exactly one row, whatever happens.

    Dask restarts a run on another worker if its worker dies; if this happens too often, its row has the
    status ``killed``.
    """
    from distributed import as_completed

    place = str(root.resolve())
    drives = _drives(client, runs, sources)
    futures = {}
    for number, run in enumerate(runs):
        future = client.submit(
            perform,
            run.to_dict(),
            place,
            drives.get(run.log, ""),
            key=f"run-{run.key}",
            priority=-number,
            pure=False,
        )
        futures[future] = run
    rows = []
    try:
        for future in as_completed(futures, loop=client.loop):  # type: ignore[no-untyped-call]
            rows.append(_row(future, futures.pop(future), root))
            on_row(rows[-1])
    finally:
        if futures:
            client.cancel(list(futures))  # type: ignore[no-untyped-call]
    return rows


def _drives(client: Client, runs: Sequence[Run], sources: Sequence[Source]) -> dict[str, Any]:
    """Futures of the simulated drives that the runs need, by path."""
    needed = {run.log for run in runs}
    futures = {}
    for source in sources:
        path = str(source.path.resolve())
        if source.drive is not None and path in needed:
            users = [run for run in runs if run.log == path]
            limits = (max(run.timeout_s for run in users), max(run.memory_mb for run in users))
            submitted = asdict(source.drive), path, *limits
            futures[path] = client.submit(record_drive, *submitted, key=f"drive-{path}", pure=False)
    return futures


def _row(future: Any, run: Run, root: Path) -> Row:
    """The row of a task that has ended, also of one that Dask gave up."""
    from slam.comparison.store import ResultStore

    try:
        row: Row = future.result()
        return row
    except Exception as error:
        store = ResultStore(root)
        known = store.row(run.key)
        if known is not None:
            return known
        lines = str(error).splitlines() or [type(error).__name__]
        outcome = Outcome("killed", f"its worker died again and again, or failed: {lines[0]}", 0.0, 0.0)
        with store.attempt() as folder:
            return store.publish(folder, run.key, row_of(run.to_dict(), outcome, None))
