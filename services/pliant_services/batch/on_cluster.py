"""The clips of a batch on the machines of a Dask cluster, one task each.

Dask assigns the clips, and gives the clip of a lost machine to another one; only the task and its
outcome go over its connections.  Clips and results are in folders that all machines see.  Killed
runs are resumed (``one_run.py``).
"""

import logging
import platform
import threading
import uuid
from collections.abc import Callable, Mapping
from typing import Any
from urllib.parse import urlsplit

from pliant.errors import BusError, ResultError
from pliant_services.batch.one_run import Errand, Outcome, run_clip

_ANSWERS_S = 10.0
_CUT_OFF_S = 30.0


def load_dask() -> Any:
    """Return the module ``distributed``.  Raises ResultError if it is not installed."""
    try:
        import distributed
    except ImportError:
        raise ResultError("--dask: needs Dask: pip install 'pliant[dask]'") from None
    return distributed


class Cluster:
    """A scheduler of Dask's that answers."""

    def __init__(self, address: str) -> None:
        """Raises ResultError, and BusError if no scheduler answers there."""
        self._address = address
        self._distributed = load_dask()
        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # our own line reports it
        try:
            # Said before there is a client, which such an address would keep from ending.
            parts = urlsplit(address if "://" in address else f"tcp://{address}")
            self._distributed.comm.registry.get_backend(parts.scheme)
            if not (parts.hostname and parts.port):
                raise ValueError("expected tcp://HOST:PORT")
            self._client = self._distributed.Client(
                address, timeout=_ANSWERS_S, set_as_default=False, name="pliant-batch"
            )
        except (OSError, ValueError, TypeError) as error:
            what = str(error).partition("\n")[0][:200]
            raise BusError(
                f"--dask {address}: no answer from a scheduler ({what}): start one with `dask "
                "scheduler`, and workers with `dask worker ADDRESS`"
            ) from None

    def close(self) -> None:
        """Leave it."""
        self._client.close()

    def run(
        self,
        errands: Mapping[str, Errand],
        begun: Callable[[str, str], None],
        over: Callable[[str, Outcome], None],
    ) -> None:
        """Run all of them.  begun, over: called with the clip, the worker, and the outcome.

        Ctrl-C cuts off those that run; raises KeyboardInterrupt then.  Raises BusError if the
        scheduler goes away.
        """
        topic = f"pliant-batch-{uuid.uuid4().hex}"
        running: set[str] = set()
        changed = threading.Condition()

        def take(event: tuple[float, tuple[str, str, float | None]]) -> None:
            name, where, spent_s = event[1]
            if where:
                begun(name, where)
            elif spent_s is not None:  # cancelled: its outcome is not delivered
                over(name, Outcome(exit_code=None, seconds=spent_s))
            with changed:
                (running.add if where else running.discard)(name)
                changed.notify_all()

        self._client.subscribe_topic(topic, take)
        names = {
            self._client.submit(_run, name, errand, topic, key=f"{topic}-{name}", pure=False): name
            for name, errand in errands.items()
        }
        try:
            for future in self._distributed.as_completed(names, loop=self._client.loop):
                over(names[future], self._outcome(future))
        except BaseException:
            self._client.cancel(list(names))
            with changed:
                changed.wait_for(lambda: not running, _CUT_OFF_S)
            raise

    def _outcome(self, future: Any) -> Outcome:
        if future.status == "finished":
            return future.result()
        if future.status in ("cancelled", "lost"):
            raise BusError(
                f"--dask {self._address}: the connection to the scheduler was lost; repeat "
                "the command to resume"
            )
        error = future.exception()
        why = str(error).partition("\n")[0]
        if isinstance(error, ModuleNotFoundError) or "pliant" in why:
            why = "Pliant is not installed on a worker: install the same release there"
        elif isinstance(error, self._distributed.scheduler.KilledWorker):
            why = "several workers died while processing it"
        return Outcome(exit_code=1, entry={"verdict": "failed", "reason": why})


def _run(name: str, errand: Errand, topic: str) -> Outcome:
    """The task, as a worker has it."""
    worker = load_dask().get_worker()
    key = worker.get_current_task()

    def unwanted() -> bool:
        """Whether its result is no longer needed, or the worker shuts down."""
        task = worker.state.tasks.get(key)
        leaves = worker.status.name in ("closing", "closed", "failed")
        return task is None or task.state == "cancelled" or leaves

    worker.log_event(topic, (name, platform.node(), None))
    spent_s = None
    try:
        outcome = run_clip(errand, unwanted)
        spent_s = outcome.seconds if outcome.exit_code is None else None
        return outcome
    finally:
        worker.log_event(topic, (name, "", spent_s))
